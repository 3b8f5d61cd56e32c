"""What a filter constrains, in the words of a table: from its own constraints, their limits and margins."""

from typing import Any

import mujoco

import safe_wrappers as sw


def constrained(env: sw.CBFActionFilter) -> str:
    """What the filter keeps, one phrase per constraint."""
    return "; ".join(_phrase(c, env) for c in env.constraints)


def promised(env: sw.CBFActionFilter) -> str:
    """Proved if every constraint is."""
    promises = {getattr(c, "promise", "best effort") for c in env.constraints}
    return "proved" if promises == {"proved"} else "best effort"


def reserve(env: sw.CBFActionFilter) -> str:
    """The constraints' margins, each in its unit."""
    return ", ".join(_margin(c, env) for c in env.constraints)


def _phrase(constraint: Any, env: sw.CBFActionFilter) -> str:
    match constraint:
        case sw.constraints.JointSpeedLimit():
            which = (
                "joint speeds"
                if constraint.joints is None
                else f"speeds of {len(constraint.joints)} joint(s)"
            )
            return f"{which} below {constraint.limit:g} {_unit(constraint, env)}"
        case sw.constraints.JointPositionLimit():
            where = ", ".join(constraint.joints or ["driven joints"])
            return f"{where} between {constraint.lower} and {constraint.upper}"
        case sw.constraints.SpeedLimit():
            point = constraint.body or "centre of mass"
            return f"speed of the {point} ({constraint.direction}) below {constraint.limit:g} m/s"
        case sw.constraints.Workspace():
            parts = []
            if constraint.low is not None or constraint.high is not None:
                parts.append(f"inside {_numbers(constraint.low)} to {_numbers(constraint.high)} m")
            if constraint.keep_out:
                room = f"{constraint.radius:g} m " if constraint.radius else ""
                parts.append(f"{room}clear of {_obstacles(constraint.keep_out)}")
            return f"{_points(constraint)} {' and '.join(parts)}"
        case sw.constraints.Clearance():
            return f"{_points(constraint)} clear of {_obstacles(constraint.obstacles)}, with room to brake"
        case sw.constraints.HeadingDriveClearance():
            return f"stopping path clear of {_obstacles(constraint.obstacles)}"
        case sw.constraints.CoastingClearance():
            parts = []
            if constraint.keep_out:
                parts.append(f"centre clear of {_obstacles(constraint.keep_out)}")
            if constraint.untouched:
                parts.append(f"outline clear of {_obstacles(constraint.untouched)}")
            return f"on all the way to rest, {' and '.join(parts)}"
        case sw.constraints.EscapeClearance():
            moving = [
                o
                for o in constraint.obstacles
                if isinstance(o, sw.constraints.TrackedDiscs | sw.constraints.Discs)
            ]
            return f"a way out clear of {_obstacles(moving)}"
        case sw.constraints.WallClearance():
            return "braking path clear of the walls"
        case sw.constraints.Traction():
            return f"slip of {len(constraint.wheels)} wheels within {constraint.max_slip:g}"
    return type(constraint).__name__


def _margin(constraint: Any, env: sw.CBFActionFilter) -> str:
    margin = float(getattr(constraint, "margin", 0.0))
    match constraint:
        case sw.constraints.JointSpeedLimit():
            return f"{margin:g} {_unit(constraint, env)}"
        case sw.constraints.SpeedLimit():
            return f"{margin:g} m/s"
        case sw.constraints.Traction():
            return f"{margin:g}"
    return f"{1e3 * margin:g} mm"


def _unit(limit: sw.constraints.JointSpeedLimit, env: sw.CBFActionFilter) -> str:
    """Of joints, which all turn or all slide."""
    model = env.unwrapped.model  # type: ignore[attr-defined]
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    kinds = {int(model.joint(name).type[0]) == slide for name in limit.joints or ()}
    return "m/s" if kinds == {True} else "rad/s"


def _points(constraint: Any) -> str:
    return ", ".join([*constraint.bodies, *constraint.sites, *constraint.geoms])


def _numbers(corner: Any) -> str:
    return (
        "anywhere"
        if corner is None
        else "(" + ", ".join("-" if v is None else f"{v:g}" for v in corner) + ")"
    )


def _obstacles(obstacles: Any) -> str:
    kinds = {type(o) for o in obstacles}
    if len(obstacles) > 2 and len(kinds) == 1:
        return f"{len(obstacles)} {kinds.pop().__name__.lower()}es"
    return " and ".join(_obstacle(o) for o in obstacles)


def _obstacle(obstacle: Any) -> str:
    match obstacle:
        case sw.constraints.Discs():
            return f"{obstacle.attribute} ({obstacle.radius:g} m)"
        case sw.constraints.TrackedDiscs():
            return f"{obstacle.attribute} ({obstacle.radius:g} m and {obstacle.sigmas:g} sigma)"
        case sw.constraints.Disc():
            return f"a disc of {obstacle.radius:g} m at {_numbers(obstacle.center)} m"
        case sw.constraints.Plane():
            return f"the end at {_numbers(obstacle.point).strip('()')} m"
    return f"a {type(obstacle).__name__.lower()}"
