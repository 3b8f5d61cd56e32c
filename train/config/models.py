"""The settings of an experiment as frozen dataclasses: for each field its type, its default and what it means.

The tables of `docs/config.md` are made of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, model_validator
from pydantic.dataclasses import dataclass

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.protect import protect_options
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty
from safe_wrappers.wrappers.replaced_actions import StuckEscape

from .algorithm_settings import HER
from .algorithms import check_algorithm
from .arguments import arguments, check_faults, check_lease, with_keys
from .env_ids import check_env_id
from .learner import NAIVE, LearnerConfig
from .learner import MarginCurriculumConfig as MarginCurriculumConfig  # for the docs: all sections are here
from .names import check_name
from .section import Section
from .sweep import ParameterConfig as ParameterConfig
from .sweep import SweepConfig
from .types import Count, FolderName, FunctionName, NonNegative

Options = dict[str, Any]


@dataclass(frozen=True)
class FilterConfig(Section):
    """Which filter: `none`, `protect`, or a mapping. A lease without a clearance is given the filter's constraint."""

    protect: Annotated[Options | None, with_keys(protect_options() - {"plant"})] = None
    """Options of `safe_wrappers.protect`, such as `margin` (added to the recipe's own)."""
    factory: FunctionName | None = None
    """`module:function`: called with the env, returns it filtered."""
    kwargs: Options = Field(default_factory=dict)
    """Further arguments of the factory."""
    lease: Annotated[Options | None, AfterValidator(check_lease)] = None
    """Arguments of a [LeaseExpiry](wrappers/lease-expiry.md) around the filter."""
    escape: Annotated[Options | None, with_keys(arguments(StuckEscape))] = None
    """Arguments of a [StuckEscape](wrappers/stuck-escape.md) around the filter."""

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, given: Any) -> Any:
        if isinstance(given, str):
            return {"protect": {}} if check_name(given, ("none", "protect")) == "protect" else {}
        if isinstance(given, Mapping):  # `protect:` without options
            return {name: {} if value is None else value for name, value in given.items()}
        return given

    @model_validator(mode="after")
    def _is_one_filter(self) -> FilterConfig:
        both = self.protect is not None and self.factory is not None
        around = self.lease is not None or self.escape is not None
        idle = (self.kwargs and self.factory is None) or (around and self.kind == "none")
        if both or idle:
            raise ConfigurationError(
                "expected none, protect, {protect: {...}} or {factory: 'module:function', kwargs: {...}}, with "
                f"lease: {{...}} and escape: {{...}} beside it if there is one; got {asdict(self)}."
            )
        return self

    @property
    def kind(self) -> Literal["none", "protect", "factory"]:
        """Where the filter comes from."""
        if self.protect is not None:
            return "protect"
        return "none" if self.factory is None else "factory"

    def plain(self) -> dict[str, Any]:
        """As run folders have it."""
        arguments = self.kwargs if self.protect is None else self.protect
        found = {"kind": self.kind, "kwargs": arguments, "factory": self.factory or "", "lease": self.lease}
        return found if self.escape is None else {**found, "escape": self.escape}


def _of_all_arms(given: Any) -> Any:
    """`constraints`, those of the evaluation's filter, the same for all arms."""
    if isinstance(given, FilterConfig | None):
        return given
    check_name(given, ("constraints",))
    return FilterConfig()  # whose constraints they are is known when all arms are


@dataclass(frozen=True)
class EnvConfig(Section):
    """Which env, and what is between the task and the filter; returns that are reported are always the task's own."""

    text_is: ClassVar[str] = "id"

    id: Annotated[str, AfterValidator(check_env_id)]
    """As for `gymnasium.make`; ids of gymnasium-robotics too, if it is installed (`pip install
    'safe-wrappers[robotics]'`). `module:Id-v0` imports the module first, which has to
    register the id."""
    kwargs: Options = Field(default_factory=dict)
    """Passed to `gymnasium.make`."""
    faults: Annotated[dict[str, Options], AfterValidator(check_faults)] = Field(default_factory=dict)
    """[Faults](wrappers/faults.md) between policy and robot, in training and evaluation: a wrapper's name and its
    arguments, the innermost first."""
    occlusion: Annotated[Options | None, with_keys(arguments(OcclusionPenalty))] = None
    """Arguments of an [OcclusionPenalty](wrappers/occlusion-penalty.md) around the task, inside the filter."""
    cost: FunctionName | None = None
    """`module:function` that judges a task without a cost of its own: [CostFunction](wrappers/cost-function.md), in
    all arms, in training and evaluation."""
    judge: Annotated[FilterConfig | None, BeforeValidator(_of_all_arms)] = None
    """`constraints`: the evaluation filter's own limits judge such a task, read from its true state, in all arms."""
    observation: Annotated[FilterConfig | None, BeforeValidator(_of_all_arms)] = None
    """`constraints`: policies observe what the filter decides by, in training and evaluation
    ([FilterObservation](wrappers/filter-observation.md)); without a filter, what the evaluation's filter would."""
    reset_options: Options = Field(default_factory=dict)
    """Options of every reset in training, such as `{layout: {hazards: []}}` of the goal tasks. Evaluation resets
    without them: every arm is judged on the task itself."""

    @model_validator(mode="after")
    def _has_one_judge(self) -> EnvConfig:
        if self.cost is not None and self.judge is not None:
            raise ConfigurationError("cost and judge both say who judges the task; leave one out.")
        return self


@dataclass(frozen=True)
class NormalizeConfig(Section):
    """What SB3's VecNormalize scales."""

    observation: StrictBool = False
    """Observations are scaled by their running mean and deviation (VecNormalize)."""
    reward: StrictBool = False
    """Rewards are scaled by the running deviation of the return (VecNormalize)."""


@dataclass(frozen=True)
class EvaluationConfig(Section):
    """Paired evaluation: the same episodes for every arm and seed."""

    episodes: Count = 10
    """Episodes per policy and condition."""
    seed: NonNegative = 1_000_000
    """Episode i starts from env seed `evaluation.seed` + i, in every arm and condition."""
    filter: FilterConfig | None = None
    """As `filter` of an arm: what is put on, in the evaluation with the filter on, where an arm has no filter of
    its own. By default the first filtered arm's."""
    films: StrictBool = True
    """Two of the episodes are filmed, in every arm and condition, where the task can draw frames."""


@dataclass(frozen=True)
class ArmConfig(Section):
    """All that decides how one arm trains."""

    name: FolderName
    env: EnvConfig
    """The env: an id, or the keys of [`env`](#env)."""
    algorithm: Annotated[str, AfterValidator(check_algorithm)]
    """`PPO`, `A2C`, `SAC`, `TD3`, `DDPG`, `DQN`; with `pip install 'sb3-contrib>=2.6,<3'` also `TQC`, `CrossQ`,
    `TRPO`, `RecurrentPPO`, `QRDQN`, `MaskablePPO`. The last two and `DQN` are for discrete actions; filtered, those
    have an [ActionShield](wrappers/action-shield.md), and `MaskablePPO` learns from its masks."""
    total_steps: Count
    """Steps of all envs together, rounded up to whole rollouts: PPO with its default of `n_steps: 2048` and four
    envs trains 8,192 steps if 4,000 are asked for. Progress and report say how many were trained. May be [raised
    later](cli.md#training-for-longer)."""
    hyperparameters: Options = Field(default_factory=dict)
    """Arguments of the algorithm's class, by SB3's names. An arm's are added to those at the top, if the algorithm
    is the same. `policy` is `MlpPolicy`, or `MultiInputPolicy` where observations are dicts, if it is not given (of
    RecurrentPPO `MlpLstmPolicy` and `MultiInputLstmPolicy`).
    `buffer_size` is `total_steps`, at most a million. What the run decides itself (`env`, `seed`, `device`,
    `verbose`, `tensorboard_log`, `stats_window_size`) is refused."""
    filter: FilterConfig = FilterConfig()
    """`none`, `protect`, or the keys of [`filter`](#filter)."""
    learner: LearnerConfig = NAIVE
    """What the learner sees where the filter changed an action: see [`learner`](#learner)."""
    start_from: str | None = None
    """An arm of this experiment, whose policy of the same seed this one begins with, or an SB3 file `*.zip`: see
    [fine-tuning](concepts/learner.md#fine-tuning)."""
    normalize: NormalizeConfig = NormalizeConfig()
    action_repeat: Count = 1
    """Control steps for which an action of the policy is held, in training and evaluation
    ([ActionRepeat](wrappers/action-repeat.md)). The filter checks each, and `total_steps` counts the policy's
    actions."""
    n_envs: Count = 1
    """Envs of a run."""
    vec_env: Literal["dummy", "subproc"] = "dummy"
    """Envs one after the other, or each in a process of its own: the same results, bit for bit. A run then has
    `n_envs` processes more; set `workers` accordingly. May be changed later."""
    checkpoint_every: Count = 50_000
    """Steps between two checkpoints, saved between two rollouts. May be changed later."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Torch's. May be changed later."""
    trackers: list[Literal["wandb", "mlflow"]] = Field(default_factory=list)
    """[Where curves and films go](cli.md#trackers) beside TensorBoard. May be changed later."""

    @property
    def replays_goals(self) -> bool:
        """Whether the replay buffer is HER's, which gives transitions new goals."""
        return self.hyperparameters.get("replay_buffer_class") == HER

    def fingerprint(self) -> dict[str, Any]:
        """What a run folder must agree on to be continued: all that changes what is learned."""
        values = asdict(self) | {"filter": self.filter.plain()}
        for harmless in ("name", "checkpoint_every", "device", "vec_env", "trackers"):
            del values[harmless]
        without_default_buffer_size(values)
        # What is as by default is left out: a setting that is added later does not change the folders of today.
        if self.learner == NAIVE:
            del values["learner"]
        else:
            values["learner"] = self.learner.plain()
        if self.start_from is None:
            del values["start_from"]
        if self.filter.lease is None:
            del values["filter"]["lease"]
        if self.action_repeat == 1:
            del values["action_repeat"]
        for key in ("judge", "observation"):
            if (of := getattr(self.env, key)) is not None:
                values["env"][key] = of.plain()
        values["env"] = {
            key: value for key, value in values["env"].items() if value or key in ("id", "kwargs")
        }
        return values


@dataclass(frozen=True)
class ExperimentConfig(Section):
    """An experiment: arms times seeds, one folder."""

    name: FolderName
    """The experiment's folder below `output`."""
    arms: tuple[ArmConfig, ...]
    """What is compared: a name for each arm, which is its folder's, and below it the arm's keys."""
    seeds: Annotated[list[NonNegative], Field(min_length=1)]
    """Every arm is trained with each: networks, exploration and envs."""
    output: Path = Path("runs")
    """Where the experiment's folder is made."""
    workers: Count | None = None
    """Runs at a time, each in a process; by default one per core."""
    evaluation: EvaluationConfig = EvaluationConfig()
    sweep: SweepConfig | None = None
    """What `safe-wrappers sweep` searches: see [`sweep`](#sweep)."""

    @property
    def folder(self) -> Path:
        """Where everything of this experiment lies."""
        return self.output / self.name

    def run_folder(self, arm: ArmConfig, seed: int) -> Path:
        """Where one run lies."""
        return self.folder / arm.name / f"seed_{seed}"

    def begins_with(self, arm: ArmConfig) -> ArmConfig | None:
        """The arm whose policy an arm begins with; None: none, or a file's."""
        return next((other for other in self.arms if other.name == arm.start_from), None)

    @property
    def evaluation_filter(self) -> FilterConfig:
        """The filter of an unfiltered arm in the condition "filter on": as given, or the first filtered arm's."""
        if self.evaluation.filter is not None:
            return self.evaluation.filter
        return next((arm.filter for arm in self.arms if arm.filter.kind != "none"), FilterConfig())


def default_buffer_size(total_steps: int) -> int:
    """Transitions: SB3's default of a million would be saved with every checkpoint, mostly empty."""
    return min(1_000_000, total_steps)


def without_default_buffer_size(fingerprint: dict[str, Any]) -> None:
    """Takes the default size of the replay buffer out of a fingerprint: it grows with `total_steps`."""
    hyperparameters = fingerprint.get("hyperparameters", {})
    if hyperparameters.get("buffer_size") == default_buffer_size(fingerprint.get("total_steps", 0)):
        del hyperparameters["buffer_size"]
