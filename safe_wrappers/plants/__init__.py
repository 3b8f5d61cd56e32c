"""Models of machines for the filter, read from an env at every step."""

from safe_wrappers.plants.analytic import AnalyticPlant
from safe_wrappers.plants.control_loop import ControlLoop
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.identified import IdentifiedPlant, log_steps
from safe_wrappers.plants.mujoco.dynamics import RigidModelCheck, rigid_model_check
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.simulator import Rollout, RolloutPlant, SimulatorPlant, View

__all__ = [
    "AnalyticPlant",
    "ControlLoop",
    "DisplacementPlant",
    "IdentifiedPlant",
    "MujocoPlant",
    "Plant",
    "RigidModelCheck",
    "Rollout",
    "RolloutPlant",
    "SimulatorPlant",
    "View",
    "log_steps",
    "rigid_model_check",
]
