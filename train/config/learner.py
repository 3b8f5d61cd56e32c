"""LearnerConfig: what the learner sees where the filter changed its action."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from safe_wrappers.errors import ConfigurationError

from .section import Section
from .types import Number


@dataclass(frozen=True)
class MarginCurriculumConfig(Section):
    """How the margin of an arm's filter changes in training, in hundredths of the way."""

    start: Annotated[Number, Field(ge=0)]
    """Added margin at the first step, in the constraints' own unit; never below 0, so that constraints keep at least
    their own."""
    end: Annotated[Number, Field(ge=0)] = 0.0
    """Added margin from `until` on; linear between."""
    until: Annotated[Number, Field(gt=0, le=1)] = 1.0
    """Share of `total_steps`."""


@dataclass(frozen=True)
class LearnerConfig(Section):
    """What the learner sees where the filter changed its action, by the names of Krasowski et al. (TMLR 2023)."""

    text_is: ClassVar[str] = "kind"
    _PENALISED: ClassVar = ("adaption_penalty", "both")
    _PENALTIES: ClassVar = ("penalty", "per_correction")

    kind: Literal["naive", "adaption_penalty", "safe_action", "both", "safe_set_map"] = "naive"
    """`safe_action` and `both` are for SAC, TD3, DDPG, TQC and CrossQ. `safe_set_map` is a
    [SafeActionMap](wrappers/safe-action-map.md) around the filter, in training and evaluation."""
    penalty: Annotated[Number, Field(ge=0)] = 0.0
    """For `adaption_penalty` and `both`: taken off the reward of a changed step."""
    per_correction: Annotated[Number, Field(ge=0)] = 0.0
    """For the same: taken off per unit of correction."""
    margin_curriculum: MarginCurriculumConfig | None = None
    """A margin that the arm's filter adds in training and that changes; see [its
    keys](concepts/learner.md#a-margin-that-changes). Evaluation has the filter as it is configured."""
    cost_limit: Annotated[Number, Field(ge=0)] | None = None
    """Cost per episode above which a [Lagrangian multiplier](sb3.md#a-price-on-cost) puts a price on cost, in
    training; with PPO this is PPO-Lagrangian. For any algorithm and arm, also without a filter."""
    multiplier_rate: Annotated[Number, Field(gt=0)] = 1e-3
    """Of that multiplier: by how much it rises after an episode, for each unit of cost above the limit."""

    @model_validator(mode="after")
    def _has_a_penalty_if_it_needs_one(self) -> LearnerConfig:
        given = bool(self.penalty or self.per_correction)
        if self.penalised and not given:
            raise ConfigurationError(
                f"{self.kind} needs a penalty in units of the task's reward, per changed step or by the size of the"
                f" correction: {{kind: {self.kind}, penalty: 0.1}}, or per_correction."
            )
        if given and not self.penalised:
            raise ConfigurationError(f"{self.kind} takes no penalty; {' and '.join(self._PENALISED)} do.")
        if self.multiplier_rate != LearnerConfig.multiplier_rate and self.cost_limit is None:
            raise ConfigurationError(
                "multiplier_rate belongs to cost_limit: {cost_limit: 25, multiplier_rate: 0.001}."
            )
        return self

    @property
    def penalties(self) -> dict[str, float]:
        """The arguments of the AdaptionPenalty."""
        return {name: getattr(self, name) for name in self._PENALTIES}

    def plain(self) -> dict[str, Any]:
        """As in the folders of runs that were made before there were more keys than three."""
        old, naive = ("kind", "penalty", "per_correction"), asdict(NAIVE)
        return {key: value for key, value in asdict(self).items() if key in old or value != naive[key]}

    @property
    def penalised(self) -> bool:
        """Whether the reward is reduced where the action was changed."""
        return self.kind in self._PENALISED

    @property
    def of_filter(self) -> bool:
        """Whether it needs a filter: all but a price on cost does."""
        return replace(self, cost_limit=None, multiplier_rate=NAIVE.multiplier_rate) != NAIVE

    @property
    def maps(self) -> bool:
        """Whether the policy's actions are mapped onto the admitted ones."""
        return self.kind == "safe_set_map"

    @property
    def in_evaluation(self) -> LearnerConfig:
        """What is left of it in evaluation: a map, which is part of the policy's interface, and nothing else."""
        return self if self.maps else NAIVE

    @property
    def stores_executed(self) -> bool:
        """Whether the replay buffer holds executed actions."""
        return self.kind in ("safe_action", "both")


NAIVE: Final = LearnerConfig()
