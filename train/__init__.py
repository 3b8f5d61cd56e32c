"""Training, paired evaluation and comparison with Stable-Baselines3: the `safe-wrappers` command.

**What is learned from.** SB3 stores the action that the policy proposed, not the one that the filter let
through: with the names of Krasowski et al. (Provably Safe Reinforcement Learning, TMLR 2023) a filtered arm
learns in the *naive* way unless its `learner` says otherwise. The filter is then part of the environment: the
policy sees the outcome of the executed action under the name of its own. PPO stays on-policy that way, and the
return is the one really obtained; what it does not learn by itself is to avoid being corrected. Two of the
paper's other choices are `learner: {kind: adaption_penalty, penalty: 0.1}`, and `learner: safe_action`, which
needs a replay buffer.
"""
