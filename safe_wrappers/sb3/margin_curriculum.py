"""MarginCurriculum: a filter's margin that changes in the course of a training."""

from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers.checks import non_negative, positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3.gymnasium_vec_env import GymnasiumVecEnv

_STAIRS = 100
"""A margin changes in so many equal steps: each binds the constraints anew."""


class MarginCurriculum(BaseCallback):
    """Sets the margin that a `CBFActionFilter` adds to those of its constraints, between rollouts.

    Linear in the share of the training's steps, in hundredths, until the share `until`; constant from there. The
    share is that of the model's own step count: a training that was saved and goes on has the margin of the place
    where it stands. Evaluation envs keep theirs.

    Args:
        start: At the first step, in the constraints' own unit (m, rad/s, ...), at least 0: constraints keep at least
            their own margins.
        end: From `until` on, likewise.
        until: Share of the training's steps, above 0 and at most 1.

    Raises:
        ConfigurationError: Numbers outside these ranges; at the training's start: an env without such a filter.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> from stable_baselines3 import PPO
        >>> from safe_wrappers.sb3 import MarginCurriculum
        >>> env = sw.protect(gym.make("Reacher-v5"))
        >>> model = PPO("MlpPolicy", env, n_steps=64, n_epochs=1, device="cpu")
        >>> _ = model.learn(256, callback=MarginCurriculum(start=1.0, end=0.0, until=0.5))
    """

    def __init__(self, start: float, end: float = 0.0, until: float = 1.0) -> None:
        super().__init__()
        self.start = non_negative("start", start, "the constraints' own units")
        self.end = non_negative("end", end, "the constraints' own units")
        self.until = positive("until", until, "a share of the training's steps")
        if self.until > 1.0:
            raise ConfigurationError(f"until is a share of the training's steps, at most 1, got {until}")
        self._margin: float | None = None

    def margin(self, share: float) -> float:
        """The added margin when this share of the training's steps is done."""
        done = min(int(_STAIRS * share / self.until + 1e-9), _STAIRS) / _STAIRS
        return (1.0 - done) * self.start + done * self.end

    def _on_training_start(self) -> None:
        self._margin = None
        if isinstance(self.training_env.unwrapped, GymnasiumVecEnv):
            raise ConfigurationError(
                "MarginCurriculum changes the filters of single envs, and a GymnasiumVecEnv decides for all at once;"
                " use a DummyVecEnv of protected envs"
            )
        if not self.training_env.has_attr("added_margin"):
            raise ConfigurationError(
                "MarginCurriculum needs envs in a CBFActionFilter, such as sw.protect(env)"
            )

    def _on_rollout_start(self) -> None:
        # SB3's total is that of the whole training, of one that goes on, too.
        margin = self.margin(self.model.num_timesteps / self.model._total_timesteps)
        if margin != self._margin:
            self.training_env.env_method("set_margin", margin)
            self._margin = margin
        self.logger.record("interventions/added_margin", margin)

    def _on_step(self) -> bool:
        return True
