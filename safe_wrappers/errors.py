"""Everything this library raises on purpose."""


class SafeWrappersError(Exception):
    """Base class: catch it to catch every refusal of this library."""


class ConfigurationError(SafeWrappersError, ValueError):
    """A constructor or a config was given something it cannot work with."""


class UnknownNameError(ConfigurationError):
    """A body, joint, geom, solver, constraint or config key does not exist; the message lists those that do."""


class UnsupportedEnvError(ConfigurationError):
    """The env lacks what a wrapper or a plant needs of it (Box action, MuJoCo model, known id)."""


class ActionError(SafeWrappersError, ValueError):
    """An action has the wrong shape or type; the env was not stepped."""


class RunStateError(SafeWrappersError):
    """A training run's folder cannot be used: it belongs to another config, or its checkpoint is damaged."""


class UnsafeStateWarning(UserWarning):
    """The state was already outside the safe set when the filter was asked to act; said once per episode."""


class PhaseMarginWarning(UserWarning):
    """Hold and delays leave a declared control loop less phase margin than it asks for; said once per plant."""
