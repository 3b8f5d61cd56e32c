"""GymnasiumVecEnv: a vector env of Gymnasium as one of Stable-Baselines3."""

from typing import Any

from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.wrappers.vector_cbf_action_filter import VectorCBFActionFilter, single_envs


class GymnasiumVecEnv(DummyVecEnv):
    """Lets an SB3 learner use a `VectorCBFActionFilter`, or another vector env around a `SyncVectorEnv`.

    Infos and observations are those that a `DummyVecEnv` of filtered envs gives. What SB3 asks of single envs
    (`get_attr`, `env_method`, ...) is answered by each env's own filter, or by the env.

    Args:
        env: With `AutoresetMode.SAME_STEP`, as SB3 resets envs.

    Raises:
        UnsupportedEnvError: Another autoreset mode, or envs in other processes.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> from safe_wrappers.sb3 import GymnasiumVecEnv
        >>> same_step = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
        >>> envs = gym.make_vec("Reacher-v5", 4, vectorization_mode="sync", vector_kwargs=same_step)
        >>> vec_env = GymnasiumVecEnv(sw.protect(envs))
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        if env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise UnsupportedEnvError(
                "SB3 resets an env in the step that ends its episode: make the vector env with "
                "autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP (make_vec takes it in vector_kwargs)"
            )
        self.vector_env = env
        self.envs = list(env.filters if isinstance(env, VectorCBFActionFilter) else single_envs(env))
        VecEnv.__init__(self, env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Reset all envs with the seeds and options that were set."""
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ConfigurationError(
                f"one vector env takes the same options for all envs, got {self._options}"
            )
        seeds: Any = list(self._seeds)
        observations: VecEnvObs
        observations, infos = self.vector_env.reset(seed=seeds, options=options or None)
        self.reset_infos = [single_info(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """Step all envs; those whose episode ends are reset."""
        observations, rewards, terminated, truncated, infos = self.vector_env.step(self.actions)
        done, finals = terminated | truncated, infos.get("final_info", {})
        listed = []
        for i in range(self.num_envs):
            info = single_info(infos, i)
            if done[i]:
                self.reset_infos[i] = {
                    key: info[key] for key in info if key not in ("final_obs", "final_info")
                }
                info = single_info(finals, i) | {"terminal_observation": info["final_obs"]}
            info["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            listed.append(info)
        return observations, rewards.astype("float32"), done, listed

    def close(self) -> None:
        """Close all envs."""
        self.vector_env.close()


def single_info(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """The info of env i of a vector env's infos."""
    said = {key: infos[key] for key in infos if f"_{key}" in infos and infos[f"_{key}"][i]}
    return {
        key: single_info(value, i) if isinstance(value, dict) else value[i] for key, value in said.items()
    }
