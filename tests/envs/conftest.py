from safe_wrappers.envs import register_envs

register_envs()
