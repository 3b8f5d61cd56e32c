"""The settings of an experiment as frozen dataclasses: for each field its type, its default and what it means.

The tables of `docs/config.md` are made of them.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

import gymnasium as gym
from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, model_validator
from pydantic.dataclasses import dataclass

from safe_wrappers.errors import ConfigurationError

from .algorithms import ALGORITHMS
from .types import (
    Count,
    FolderName,
    FunctionName,
    NonNegative,
    Number,
    Options,
    Section,
    check_name,
    validate,
)


def check_env_id(env_id: str) -> str:
    """Returns the id; refuses one that no installed package registers.

    Imports gymnasium-robotics if it may be one of its ids. An id of the form `module:Id-v0` is left to
    `gymnasium.make`, which imports the module.
    """
    if ":" in env_id or env_id in gym.registry:
        return env_id
    if importlib.util.find_spec("gymnasium_robotics") is not None:
        gym.register_envs(importlib.import_module("gymnasium_robotics"))  # its import registers them
    return check_name(env_id, gym.registry)


@dataclass(frozen=True)
class LearnerConfig(Section):
    """What the learner sees where the filter changed its action, by the names of Krasowski et al. (TMLR 2023)."""

    text_is: ClassVar[str] = "kind"

    kind: Literal["naive", "adaption_penalty", "safe_action"] = "naive"
    """`safe_action` is for SAC, TD3, DDPG, TQC and CrossQ, sbx's too."""
    penalty: Annotated[Number, Field(ge=0)] = 0.0
    """For `adaption_penalty`: taken off the reward of a changed step."""
    cost_limit: Annotated[Number, Field(ge=0)] | None = None
    """Cost per episode above which a [Lagrangian multiplier](sb3.md#a-price-on-cost)
    puts a price on cost, in training; with PPO this is PPO-Lagrangian. For any algorithm and arm, also without a
    filter."""
    multiplier_rate: Annotated[Number, Field(gt=0)] = 1e-3
    """Of that multiplier: by how much it rises after an episode, for each unit of cost above the limit."""

    @model_validator(mode="after")
    def _has_a_penalty_if_it_needs_one(self) -> LearnerConfig:
        if self.penalised and not self.penalty:
            raise ConfigurationError(
                f"{self.kind} needs a penalty per changed step, in units of the task's reward: {{kind: {self.kind},"
                " penalty: 0.1}."
            )
        if self.penalty and not self.penalised:
            raise ConfigurationError(f"{self.kind} takes no penalty; adaption_penalty does.")
        return self

    @property
    def penalised(self) -> bool:
        """Whether the reward is reduced where the action was changed."""
        return self.kind == "adaption_penalty"

    @property
    def stores_executed(self) -> bool:
        """Whether the replay buffer holds executed actions."""
        return self.kind == "safe_action"


NAIVE: Final = LearnerConfig()


@dataclass(frozen=True)
class FilterConfig(Section):
    """Which filter: `none`, `protect`, or a mapping. A lease without a clearance is given the filter's constraint."""

    protect: Options | None = None
    """Options of `safe_wrappers.protect`, such as `margin` (added to the recipe's own)."""
    factory: FunctionName | None = None
    """`module:function`: called with the env, returns it filtered."""
    kwargs: Options = Field(default_factory=dict)
    """Further arguments of the factory."""
    lease: Options | None = None
    """Arguments of a [LeaseExpiry](wrappers/late-commands.md#leaseexpiry) around the filter."""
    stuck: Options | None = None
    """Arguments of a [StuckMonitor](wrappers/learner.md#stuckmonitor) around the filter."""

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
        around = self.lease is not None or self.stuck is not None
        idle = (self.kwargs and self.factory is None) or (around and self.kind == "none")
        if both or idle:
            raise ConfigurationError(
                "expected none, protect, {protect: {...}} or {factory: 'module:function', kwargs: {...}}, with "
                f"lease: {{...}} and stuck: {{...}} beside it if there is one; got {asdict(self)}."
            )
        return self

    @property
    def kind(self) -> Literal["none", "protect", "factory"]:
        """Where the filter comes from."""
        if self.protect is not None:
            return "protect"
        return "none" if self.factory is None else "factory"


def _of_all_arms(given: Any) -> Any:
    """`constraints`, those of the evaluation's filter, the same for all arms."""
    if isinstance(given, str):
        check_name(given, ("constraints",))
        return FilterConfig()  # whose constraints they are is known when all arms are
    return given


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
    faults: dict[str, Options] = Field(default_factory=dict)
    """[Faults](wrappers/recording.md#faults) between policy and robot, in training and evaluation: a wrapper's
    name and its arguments, the innermost first."""
    occlusion: Options | None = None
    """Arguments of an [OcclusionPenalty](wrappers/occlusion-penalty.md) around the task, inside the filter."""
    cost: FunctionName | None = None
    """`module:function` that judges a task without a cost of its own:
    [CostFunction](wrappers/recording.md#costfunction), in all arms, in training and evaluation."""
    judge: Annotated[FilterConfig | None, BeforeValidator(_of_all_arms)] = None
    """`constraints`: the evaluation filter's own limits judge such a task, read from its true state, in all arms."""
    observation: Annotated[FilterConfig | None, BeforeValidator(_of_all_arms)] = None
    """`constraints`: policies observe what the filter decides by, in training and evaluation
    ([FilterObservation](wrappers/learner.md#filterobservation)); without a filter, what the evaluation's filter
    would."""

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
    """One of the episodes is filmed, the same in every arm and condition, where the task can draw frames."""


@dataclass(frozen=True)
class ArmConfig(Section):
    """All that decides how one arm trains."""

    name: FolderName
    env: EnvConfig
    """The env: an id, or the keys of [`env`](#env)."""
    algorithm: Annotated[str, AfterValidator(lambda name: check_name(name, ALGORITHMS))]
    """`PPO`, `A2C`, `SAC`, `TD3`, `DDPG`, `DQN`; with `pip install 'sb3-contrib>=2.7,<3'` also `TQC`, `CrossQ`,
    `TRPO`, `QRDQN`; with `pip install 'safe-wrappers[sbx]'` also `sbx.SAC`, `sbx.TD3`, `sbx.TQC`, `sbx.CrossQ`,
    `sbx.PPO`, [in JAX](concepts/learner.md#which-algorithm-can-do-which). `DQN` and `QRDQN` are for discrete actions;
    filtered, those have an [ActionShield](wrappers/filter.md#actionshield)."""
    total_steps: Count
    """Steps of all envs together, rounded up to whole rollouts: PPO with its default of `n_steps: 2048` and four
    envs trains 8,192 steps if 4,000 are asked for. Progress and report say how many were trained. May be [raised
    later](cli.md#training-for-longer)."""
    hyperparameters: Options = Field(default_factory=dict)
    """Arguments of the algorithm's class, by SB3's names. An arm's are added to those at the top, if the algorithm
    is the same. `policy` is `MlpPolicy`, or `MultiInputPolicy` where observations are dicts, if it is not given.
    `buffer_size` is `total_steps`, at most a million. What the run decides itself (`env`, `seed`, `device`,
    `verbose`, `tensorboard_log`, `stats_window_size`, the class of the replay buffer) is refused."""
    filter: FilterConfig = FilterConfig()
    """`none`, `protect`, or the keys of [`filter`](#filter)."""
    learner: LearnerConfig = NAIVE
    """What the learner sees where the filter changed an action: see [`learner`](#learner)."""
    normalize: NormalizeConfig = NormalizeConfig()
    action_repeat: Count = 1
    """Control steps for which an action of the policy is held, in training and evaluation
    ([ActionRepeat](wrappers/learner.md#actionrepeat)). The filter checks each, and `total_steps` counts the policy's
    actions."""
    n_envs: Count = 1
    """Envs of a run."""
    checkpoint_every: Count = 50_000
    """Steps between two checkpoints, saved between two rollouts. May be changed later."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Torch's; sbx's algorithms are refused another than `cpu`. May be changed later."""
    trackers: list[Literal["wandb", "mlflow"]] = Field(default_factory=list)
    """[Where curves go](cli.md#where-everything-lies) beside TensorBoard. May be changed later."""

    def fingerprint(self) -> dict[str, Any]:
        """What a run folder must agree on to be continued: all that changes what is learned."""
        harmless = ("name", "checkpoint_every", "device", "trackers")
        return {key: value for key, value in self.plain().items() if key not in harmless}


def stored_arm(name: str, fingerprint: Mapping[str, Any]) -> ArmConfig:
    """The arm of a name whose `ArmConfig.fingerprint` this is; what that leaves out has its default.

    Raises:
        ConfigurationError: It is no fingerprint, or one of a later version.
    """
    arm: ArmConfig = validate(ArmConfig, {**fingerprint, "name": name}, f"arms.{name}")
    return arm


@dataclass(frozen=True)
class SweepConfig(Section):
    """What `safe-wrappers sweep` searches; other commands leave it alone."""

    parameters: Annotated[dict[str, Options], Field(min_length=1)]
    """The settings that are searched, by the keys of the command line (`hyperparameters.learning_rate`,
    `arms.filtered.filter.protect.margin`), each with its range, `{low: 1e-5, high: 1e-3, log: true}` (integers
    alone give integers; `step` as Optuna has it), or its choices, `{choices: [...]}`."""
    trials: Count = 20
    """How many are tried. May be raised later: the same command goes on."""
    at_once: Count = 1
    """Trials that are drawn together and run at the same time. More use more cores or nodes, and know less of each
    other. With `seed` it decides what is drawn, on any machine."""
    seed: NonNegative = 0
    """Of the search."""


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

    @property
    def evaluation_filter(self) -> FilterConfig:
        """The filter of an unfiltered arm in the condition "filter on": as given, or the first filtered arm's."""
        if self.evaluation.filter is not None:
            return self.evaluation.filter
        return next((arm.filter for arm in self.arms if arm.filter.kind != "none"), FilterConfig())
