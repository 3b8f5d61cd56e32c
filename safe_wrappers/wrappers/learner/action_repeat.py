"""ActionRepeat: the policy decides once for several control steps."""

from typing import Any, ClassVar

from safe_wrappers.checks import whole_number
from safe_wrappers.plants.env_checks import reward_numbers
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.chunk_handover import macro_info
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Step


class ActionRepeat(LayerWrapper):
    """Executes an action for several control steps, each of which the filter inside checks anew.

    Rewards are summed up, and the info keys of this library merged over the control steps (`safe_wrappers.info`). A
    learner explores farther with actions that last, and sees sooner what the filter makes of them: at 50 control
    steps per second, the noise of a Gaussian policy averages out before the robot has moved.

    Args:
        env: A filter, recorders and penalties, which count control steps, belong inside.
        repeat: Control steps per action; fewer where the episode ends.

    Raises:
        ConfigurationError: `repeat` is not a whole number of at least 1, or the env's steps are chunks already.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.ActionRepeat(sw.protect(gym.make("SafePointGoal1-v0")), repeat=4)
        >>> _ = env.reset(seed=0)
        >>> _, reward, _, _, info = env.step(env.action_space.sample())
    """

    layer: ClassVar = Layer.HANDOVER

    def __init__(self, env: Env, repeat: int) -> None:
        LayerWrapper.__init__(self, env)
        self.repeat = whole_number("repeat", repeat, least=1)
        self._record({"repeat": self.repeat})

    def step(self, action: Any) -> Step:
        """Step the env with the same action until `repeat` control steps are made or the episode ends."""
        total: Any = 0.0
        infos = []
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self._pass_on(action)
            total = total + reward_numbers(reward)
            infos.append(info)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, macro_info(infos)
