"""What a viewer sees of a rover's scenario: hazards, patches of ground, the floor."""

from typing import Final

import mujoco

from .layout import RoverLayout

_PARKED: Final = 1000.0  # m: farther than the rover gets in an episode
_COLOURS: Final = {
    "dry": (0.55, 0.5, 0.45, 0.6),
    "wet": (0.25, 0.35, 0.45, 0.6),
    "snow": (1.0, 1.0, 1.0, 0.9),
    "ice": (0.65, 0.9, 1.0, 0.9),
}


class Scene:
    """Markers of a model; none of them touches anything."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._floor = int(model.geom("floor").id)
        self._floor_colour = model.geom_rgba[self._floor].copy()
        self._patch_geoms = [g for g in range(model.ngeom) if model.geom(g).name.startswith("patch")]

    def show(self, model: mujoco.MjModel, data: mujoco.MjData, layout: RoverLayout) -> None:
        """Move hazards and patches where the layout has them."""
        mocap = data.mocap_pos
        mocap[1:, :2] = _PARKED
        n = len(layout.hazards)
        mocap[1 : 1 + n, :2] = layout.hazards
        first = len(mocap) - len(self._patch_geoms)
        for i, (patch, geom) in enumerate(zip(layout.patches, self._patch_geoms, strict=False)):
            mocap[first + i, :2] = patch.center
            model.geom_size[geom, 0] = model.geom_rbound[geom] = patch.radius
            model.geom_rgba[geom] = _COLOURS[patch.ground]
        bare = layout.ground == "dry"
        model.geom_rgba[self._floor] = self._floor_colour if bare else (*_COLOURS[layout.ground][:3], 1.0)
