"""An experiment's settings: a plain dict becomes frozen dataclasses, or is refused with the nearest name."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from safe_wrappers.deprecation import deprecated_names
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.protect import protect_options
from safe_wrappers.wrappers.faults import FAULTS
from safe_wrappers.wrappers.lease.stopping_budget import StoppingBudget
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty

from .algorithms import ALGORITHMS, DETERMINISTIC, DISCRETE, OFF_POLICY, ON_POLICY, check_algorithm
from .env_ids import check_env_id
from .hyperparameters import HER, SCHEDULED, check_action_noise, check_her, linear_start
from .names import check_name

# What the run itself decides; the rest of the constructor's arguments are hyperparameters.
_NOT_HYPERPARAMETERS: Final = {"self", "env", "seed", "device", "verbose", "tensorboard_log"} | {
    "_init_setup_model",
    "stats_window_size",
}
# What a YAML file can hold of what `protect` takes.
_PROTECT_OPTIONS: Final = protect_options() - {"plant"}
_LEASE_OPTIONS: Final = [
    name
    for name in (*inspect.signature(LeaseExpiry).parameters, *deprecated_names(LeaseExpiry))
    if name not in ("env", "plant", "measured")  # what a YAML file cannot hold
]
_BUDGET_OPTIONS: Final = [field.name for field in fields(StoppingBudget)]
_OCCLUSION_OPTIONS: Final = [name for name in inspect.signature(OcclusionPenalty).parameters if name != "env"]
_ARM_KEYS: Final = (
    "filter",
    "learner",
    "env",
    "algorithm",
    "hyperparameters",
    "normalize",
    "total_steps",
    "n_envs",
    "vec_env",
    "checkpoint_every",
    "device",
)
_COMMON_KEYS: Final = tuple(key for key in _ARM_KEYS if key not in ("filter", "learner"))
LEARNERS: Final = ("naive", "adaption_penalty", "safe_action", "both")
_KWARGS: Final = "hyperparameters.replay_buffer_kwargs"
_PENALISED: Final = ("adaption_penalty", "both")
_EXECUTED: Final = ("safe_action", "both")


@dataclass(frozen=True)
class EnvConfig:
    """Which env: `env: Id-v0`, or `env: {id: Id-v0, kwargs: {...}, occlusion: {...}, faults: {Outages: {...}}, ...}`.

    `occlusion` holds the arguments of an `OcclusionPenalty` around the task and inside the filter, in training and
    evaluation. Its penalty is the learner's: every return that is reported is the task's own.

    `faults` go wrong between the policy and the robot in all arms, filtered or not, in training and evaluation:
    names and arguments of `safe_wrappers.wrappers.faults`, the innermost first.

    A task that reports no cost is judged, in all arms, in training and evaluation, by one of

    - `cost: module:function`, a `CostFunction`: the function takes the unwrapped env and returns a number;
    - `judge: constraints`: the limits of the evaluation's filter, a `ConstraintJudge`.
    """

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, dict[str, Any]] = field(default_factory=dict)
    occlusion: dict[str, Any] | None = None
    cost: str | None = None
    judge: FilterConfig | None = None
    """Whose constraints judge."""


@dataclass(frozen=True)
class FilterConfig:
    """Which filter: `none`, `protect`, `{protect: {...}}`, `{factory: "module:function", kwargs: {...}}`.

    With `lease: {...}` beside it, the arguments of a `LeaseExpiry` around the filter; its budget's clearance, if left
    out, is the filter's own constraint.
    """

    kind: str = "none"
    kwargs: dict[str, Any] = field(default_factory=dict)
    factory: str = ""
    lease: dict[str, Any] | None = None


@dataclass(frozen=True)
class LearnerConfig:
    """What the learner sees where the filter changed its action, by the names of Krasowski et al. (TMLR 2023).

    - `naive`: its own action and the task's reward;
    - `adaption_penalty`: its own action and the reward less a penalty (`AdaptionPenalty`);
    - `safe_action`: the executed action and the task's reward (`ExecutedActionReplayBuffer`);
    - `both`: the transitions of the two before.

    The last two need a replay buffer, so that the on-policy algorithms (PPO, A2C, TRPO) cannot have them.

    In a config `learner: safe_action`, or `learner: {kind: both, penalty: 0.1, per_correction: 0.0}`. Only training
    has the penalty; evaluation, and every return that is reported, is the task's own.
    """

    kind: str = "naive"
    penalty: float = 0.0
    per_correction: float = 0.0

    @property
    def penalised(self) -> bool:
        """Whether the reward is reduced where the action was changed."""
        return self.kind in _PENALISED

    @property
    def stores_executed(self) -> bool:
        """Whether the replay buffer holds executed actions."""
        return self.kind in _EXECUTED


NAIVE: Final = LearnerConfig()
"""The default, which is all that there was before there was a choice."""


@dataclass(frozen=True)
class NormalizeConfig:
    """What SB3's VecNormalize scales by its running statistics."""

    observation: bool = False
    reward: bool = False


@dataclass(frozen=True)
class EvaluationConfig:
    """Paired evaluation: episode i of every arm and seed starts from env seed `seed + i`."""

    episodes: int = 10
    seed: int = 1_000_000


@dataclass(frozen=True)
class ArmConfig:
    """All that decides how one arm trains."""

    name: str
    filter: FilterConfig
    env: EnvConfig
    algorithm: str
    hyperparameters: dict[str, Any]
    normalize: NormalizeConfig
    total_steps: int
    n_envs: int
    checkpoint_every: int
    device: str
    learner: LearnerConfig = NAIVE
    vec_env: str = "dummy"

    @property
    def replays_goals(self) -> bool:
        """Whether the replay buffer is HER's, which gives transitions new goals."""
        return self.hyperparameters.get("replay_buffer_class") == HER

    def fingerprint(self) -> dict[str, Any]:
        """What a run folder must agree on to be continued: all that changes what is learned."""
        values = asdict(self)
        for harmless in ("name", "checkpoint_every", "device", "vec_env"):
            del values[harmless]
        without_default_buffer_size(values)
        # As in the folders of runs that were made before there was a choice.
        if self.learner == NAIVE:
            del values["learner"]
        if not self.env.faults:
            del values["env"]["faults"]
        for optional in ("occlusion", "cost", "judge"):
            if values["env"][optional] is None:
                del values["env"][optional]
        if self.filter.lease is None:
            del values["filter"]["lease"]
        return values


@dataclass(frozen=True)
class ExperimentConfig:
    """An experiment: arms times seeds, one folder."""

    name: str
    arms: tuple[ArmConfig, ...]
    seeds: tuple[int, ...]
    evaluation: EvaluationConfig
    output: Path
    workers: int | None
    given_evaluation_filter: FilterConfig | None = None

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
        if self.given_evaluation_filter is not None:
            return self.given_evaluation_filter
        return next((arm.filter for arm in self.arms if arm.filter.kind != "none"), FilterConfig())


def parse_experiment(settings: Mapping[str, Any]) -> ExperimentConfig:
    """Checks every setting of an experiment.

    Args:
        settings: What `read_config` returned.

    Returns:
        The experiment.

    Raises:
        UnknownNameError: A key, an algorithm or an env id that does not exist.
        ConfigurationError: A value of the wrong type or outside its range, or a missing one.
    """
    valid = ("name", "arms", "seeds", "evaluation", "output", "workers", *_COMMON_KEYS)
    for key in settings:
        check_name(key, valid, "config")
    for key in ("name", "env", "algorithm", "total_steps", "arms", "seeds"):
        if key not in settings:
            raise ConfigurationError(f"config: {key!r} is missing.")
    common = {key: settings[key] for key in _COMMON_KEYS if key in settings}
    arms = _mapping(settings["arms"], "arms")
    if not arms:
        raise ConfigurationError("arms: expected at least one, such as `unfiltered: {filter: none}`.")
    workers = settings.get("workers")
    filter_given = _mapping(settings.get("evaluation"), "evaluation").get("filter")
    experiment = ExperimentConfig(
        name=_folder_name(settings["name"], "name"),
        arms=tuple(_arm(name, _mapping(arm, f"arms.{name}"), common) for name, arm in arms.items()),
        seeds=_seeds(settings["seeds"]),
        evaluation=_evaluation(settings.get("evaluation")),
        output=Path(_text(settings.get("output", "runs"), "output")),
        workers=None if workers is None else _integer(workers, "workers", 1),
        given_evaluation_filter=None if filter_given is None else _filter(filter_given, "evaluation.filter"),
    )
    for arm in experiment.arms:
        if arm.algorithm in DISCRETE and experiment.evaluation_filter.kind != "none":
            raise ConfigurationError(
                f"arms.{arm.name}: {arm.algorithm} has discrete actions, and no filter of this library takes those,"
                " but evaluation would put a filter on (evaluation.filter, or that of another arm). Give the arm an"
                " experiment of its own, or set evaluation.filter to none."
            )
    return replace(experiment, arms=tuple(_judged(arm, experiment) for arm in experiment.arms))


def _judged(arm: ArmConfig, experiment: ExperimentConfig) -> ArmConfig:
    """With the filter whose constraints judge: the same one for all arms, so that they can be compared."""
    if arm.env.judge is None:
        return arm
    judge = replace(experiment.evaluation_filter, lease=None)
    if judge.kind == "none":
        raise ConfigurationError(
            "env.judge: there is no filter whose constraints could judge; give an arm or the evaluation one "
            "(evaluation: {filter: protect}), or use env.cost: module:function."
        )
    return replace(arm, env=replace(arm.env, judge=judge))


def _arm(name: object, own: Mapping[str, Any], common: Mapping[str, Any]) -> ArmConfig:
    where = f"arms.{name}"
    for key in own:
        check_name(key, _ARM_KEYS, where)
    merged = {**common, **own}
    algorithm = check_algorithm(merged["algorithm"], f"{where}.algorithm")
    hyperparameters = dict(_mapping(own.get("hyperparameters"), f"{where}.hyperparameters"))
    if algorithm == common["algorithm"]:  # another algorithm's hyperparameters would not fit
        inherited = _mapping(common.get("hyperparameters"), "hyperparameters")
        hyperparameters = {**inherited, **hyperparameters}
    total_steps = _integer(merged["total_steps"], "total_steps", 1)
    arm = ArmConfig(
        name=_folder_name(name, "arms"),
        filter=_filter(own.get("filter"), f"{where}.filter"),
        env=_env(merged["env"]),
        algorithm=algorithm,
        hyperparameters=_hyperparameters(algorithm, hyperparameters),
        normalize=_normalize(merged.get("normalize")),
        total_steps=total_steps,
        n_envs=_integer(merged.get("n_envs", 1), "n_envs", 1),
        checkpoint_every=_integer(merged.get("checkpoint_every", 50_000), "checkpoint_every", 1),
        device=check_name(merged.get("device", "cpu"), ("cpu", "cuda", "auto"), "device"),
        learner=_learner(own.get("learner"), f"{where}.learner"),
        vec_env=check_name(merged.get("vec_env", "dummy"), ("dummy", "subproc"), "vec_env"),
    )
    _check_actions(arm, where)
    _check_learner(arm, f"{where}.learner")
    _check_replay(arm)
    if arm.algorithm not in ON_POLICY:
        # SB3's default of a million transitions would be saved with every checkpoint, mostly empty.
        arm.hyperparameters.setdefault("buffer_size", _default_buffer_size(total_steps))
    return arm


def without_default_buffer_size(fingerprint: dict[str, Any]) -> None:
    """Takes the default size of the replay buffer out of a fingerprint: it grows with `total_steps`."""
    hyperparameters = fingerprint.get("hyperparameters", {})
    if hyperparameters.get("buffer_size") == _default_buffer_size(fingerprint.get("total_steps", 0)):
        del hyperparameters["buffer_size"]


def _default_buffer_size(total_steps: int) -> int:
    return min(1_000_000, total_steps)


def _hyperparameters(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    signature = inspect.signature(ALGORITHMS[algorithm])
    parameters = {k: v for k, v in signature.parameters.items() if k not in _NOT_HYPERPARAMETERS}
    for key, value in given.items():
        check_name(key, parameters, f"hyperparameters of {algorithm}")
        default = parameters[key].default
        where = f"hyperparameters.{key}"
        if key in SCHEDULED and isinstance(value, str):
            linear_start(value, where)
        elif key == "learning_rate":
            _number(value, where, above=0.0)
        elif key == "action_noise":
            check_action_noise(value, where)
        elif key == "replay_buffer_class":
            check_name(value, (HER,), where)
        elif isinstance(default, bool):
            _flag(value, where)
        elif isinstance(default, int) and key != "train_freq":  # train_freq may be [4, "episode"]
            _integer(value, where, 0 if key in ("learning_starts", "sde_sample_freq") else None)
        elif isinstance(default, float):
            _number(value, where)
        if key in ("n_steps", "batch_size", "n_epochs", "buffer_size"):
            _integer(value, where, 1)
    return dict(given)


def _filter(value: Any, where: str) -> FilterConfig:
    expected = (
        "expected none, protect, {protect: {...}} or {factory: 'module:function', kwargs: {...}}, with lease: {...} "
        "beside it if there is one"
    )
    if value is None or isinstance(value, str):
        return FilterConfig(kind=check_name(value or "none", ("none", "protect"), where))
    if not isinstance(value, dict):
        raise ConfigurationError(f"{where}: {expected}; got {value!r}.")
    for key in value:
        check_name(key, ("protect", "factory", "kwargs", "lease"), where)
    lease = None
    if "lease" in value:
        lease = dict(_mapping(value["lease"], f"{where}.lease"))
        for key in lease:
            check_name(key, _LEASE_OPTIONS, f"{where}.lease")
        if "budget" in lease:
            lease["budget"] = dict(_mapping(lease["budget"], f"{where}.lease.budget"))
            for key in lease["budget"]:
                check_name(key, _BUDGET_OPTIONS, f"{where}.lease.budget")
    value = {key: given for key, given in value.items() if key != "lease"}
    if set(value) == {"protect"}:
        options = dict(_mapping(value["protect"], f"{where}.protect"))
        for key in options:
            check_name(key, _PROTECT_OPTIONS, f"{where}.protect")
        return FilterConfig("protect", options, lease=lease)
    if "factory" in value and "protect" not in value:
        factory = _function_name(value["factory"], f"{where}.factory")
        return FilterConfig("factory", dict(_mapping(value.get("kwargs"), f"{where}.kwargs")), factory, lease)
    raise ConfigurationError(f"{where}: {expected}; got {value!r}.")


def _learner(value: Any, where: str) -> LearnerConfig:
    if value is None or isinstance(value, str):
        value = {"kind": value or "naive"}
    value = _mapping(value, where)
    for key in value:
        check_name(key, ("kind", "penalty", "per_correction"), where)
    learner = LearnerConfig(
        kind=check_name(value.get("kind"), LEARNERS, f"{where}.kind"),
        penalty=_number(value.get("penalty", 0.0), f"{where}.penalty"),
        per_correction=_number(value.get("per_correction", 0.0), f"{where}.per_correction"),
    )
    if min(learner.penalty, learner.per_correction) < 0:
        raise ConfigurationError(f"{where}: penalties are at least 0, got {dict(value)}.")
    if learner.penalised and learner.penalty == learner.per_correction == 0:
        raise ConfigurationError(
            f"{where}: {learner.kind} needs a penalty in units of the task's reward, per changed step or per unit of"
            f" correction: {{kind: {learner.kind}, penalty: 0.1}} or {{kind: {learner.kind}, per_correction: 0.1}}."
        )
    if not learner.penalised and (learner.penalty or learner.per_correction):
        raise ConfigurationError(f"{where}: {learner.kind} takes no penalty; {' and '.join(_PENALISED)} do.")
    return learner


def _check_learner(arm: ArmConfig, where: str) -> None:
    kind = arm.learner.kind
    if kind != "naive" and arm.filter.kind == "none":
        raise ConfigurationError(
            f"{where}: without a filter no action is ever changed; leave `learner` out, or give the arm a filter."
        )
    if not arm.learner.stores_executed:
        return
    if arm.algorithm in ON_POLICY:
        raise ConfigurationError(
            f"{where}: {arm.algorithm} cannot learn from the executed action: it weighs an action by the probability"
            " with which its policy drew it, and the policy did not draw this one. Use naive or adaption_penalty, or"
            f" {kind} with {', '.join(OFF_POLICY[:-1])} or {OFF_POLICY[-1]}."
        )
    if not arm.replays_goals and "replay_buffer_kwargs" in arm.hyperparameters:
        raise ConfigurationError(
            f"{where}: {kind} sets hyperparameters.replay_buffer_kwargs itself; leave it out, or give"
            f" hyperparameters.replay_buffer_class: {HER} with it."
        )
    if arm.hyperparameters.get("n_steps", 1) > 1:
        raise ConfigurationError(
            f"{where}: {kind} has one-step returns, hyperparameters.n_steps is {arm.hyperparameters['n_steps']}: SB3"
            " makes n-step returns with a buffer of its own. Leave n_steps out, or use naive or adaption_penalty."
        )


def _check_actions(arm: ArmConfig, where: str) -> None:
    if arm.algorithm in DISCRETE and arm.filter.kind != "none":
        raise ConfigurationError(
            f"{where}.filter: {arm.algorithm} has discrete actions, and no filter of this library takes those: leave"
            f" `filter` out. Algorithms that train through a filter: {', '.join(ON_POLICY + OFF_POLICY)}."
        )
    if arm.algorithm in DETERMINISTIC and "action_noise" not in arm.hyperparameters:
        raise ConfigurationError(
            f"{where}: the policy of {arm.algorithm} is deterministic and tries nothing out by itself. Give"
            " hyperparameters.action_noise: {normal: 0.1} (a standard deviation of actions scaled to [-1, 1]) or"
            " {ornstein_uhlenbeck: 0.1}; or none, if the random actions of the first `learning_starts` steps are to"
            " be all."
        )


def _check_replay(arm: ArmConfig) -> None:
    if not arm.replays_goals:
        return
    check_her(_mapping(arm.hyperparameters.get("replay_buffer_kwargs"), _KWARGS), _KWARGS)
    if arm.hyperparameters.get("n_steps", 1) > 1:
        raise ConfigurationError(
            f"hyperparameters.n_steps: {HER} has one-step returns, whatever n_steps says; leave it out."
        )
    if arm.env.occlusion is not None:
        raise ConfigurationError(
            f"env.occlusion: {HER} asks the task for the rewards of other goals, and the task does not know of this"
            " penalty: most transitions would go without. Leave one of the two out."
        )


def _env(value: Any) -> EnvConfig:
    if isinstance(value, str):
        value = {"id": value}
    value = _mapping(value, "env")
    for key in value:
        check_name(key, ("id", "kwargs", "faults", "occlusion", "cost", "judge"), "env")
    env_id = _text(value.get("id"), "env.id")
    check_env_id(env_id)
    occlusion = None
    if value.get("occlusion") is not None:
        occlusion = dict(_mapping(value["occlusion"], "env.occlusion"))
        for key in occlusion:
            check_name(key, _OCCLUSION_OPTIONS, "env.occlusion")
    kwargs = dict(_mapping(value.get("kwargs"), "env.kwargs"))
    cost = None if value.get("cost") is None else _function_name(value["cost"], "env.cost")
    judge = None
    if value.get("judge") is not None:
        check_name(value["judge"], ("constraints",), "env.judge")
        judge = FilterConfig()  # whose constraints they are is known when all arms are
        if cost is not None:
            raise ConfigurationError("env: cost and judge both say who judges the task; leave one out.")
    return EnvConfig(env_id, kwargs, _faults(value.get("faults")), occlusion, cost, judge)


def _faults(value: Any) -> dict[str, dict[str, Any]]:
    faults = {}
    for name, arguments in _mapping(value, "env.faults").items():
        check_name(name, FAULTS, "env.faults")
        where = f"env.faults.{name}"
        faults[name] = dict(_mapping(arguments, where))
        for key in faults[name]:
            check_name(key, [p for p in inspect.signature(FAULTS[name]).parameters if p != "env"], where)
    return faults


def _normalize(value: Any) -> NormalizeConfig:
    value = _mapping(value, "normalize")
    for key in value:
        check_name(key, ("observation", "reward"), "normalize")
    return NormalizeConfig(**{key: _flag(flag, f"normalize.{key}") for key, flag in value.items()})


def _evaluation(value: Any) -> EvaluationConfig:
    value = _mapping(value, "evaluation")
    for key in value:
        check_name(key, ("episodes", "seed", "filter"), "evaluation")
    return EvaluationConfig(
        episodes=_integer(value.get("episodes", EvaluationConfig.episodes), "evaluation.episodes", 1),
        seed=_integer(value.get("seed", EvaluationConfig.seed), "evaluation.seed", 0),
    )


def _seeds(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not value:
        raise ConfigurationError(f"seeds: expected a list such as [0, 1, 2], got {value!r}.")
    seeds = tuple(_integer(seed, "seeds", 0) for seed in value)
    if len(set(seeds)) < len(seeds):
        raise ConfigurationError(f"seeds: each may be given once, got {value!r}.")
    return seeds


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ConfigurationError(f"{where}: expected a mapping (`key: value`), got {value!r}.")
    return value


def _integer(value: Any, where: str, least: int | None = None) -> int:
    if isinstance(value, float) and value.is_integer():
        value = int(value)  # 3e5 steps
    if isinstance(value, bool) or not isinstance(value, int) or (least is not None and value < least):
        bound = "" if least is None else f" of at least {least}"
        raise ConfigurationError(f"{where}: expected an integer{bound}, got {value!r}.")
    return value


def _number(value: Any, where: str, above: float = -math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not above < value < math.inf:
        bound = "" if above == -math.inf else f" above {above:g}"
        raise ConfigurationError(f"{where}: expected a finite number{bound}, got {value!r}.")
    return value


def _flag(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise ConfigurationError(f"{where}: expected true or false, got {value!r}.")
    return value


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or not value:
        raise ConfigurationError(f"{where}: expected a text, got {value!r}.")
    return value


def _function_name(value: Any, where: str) -> str:
    name = _text(value, where)
    if not re.fullmatch(r"[\w.]+:\w+", name):
        raise ConfigurationError(f"{where}: expected 'module:function', got {name!r}.")
    return name


def _folder_name(value: Any, where: str) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9][\w.-]*", value):
        raise ConfigurationError(
            f"{where}: expected a name that can be a folder's (letters, digits, '_', '-', '.'),"
            f" got {value!r}."
        )
    return value
