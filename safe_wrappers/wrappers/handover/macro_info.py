"""The info of many control steps as the info of one step of a chunked policy."""

from typing import Any, Final

import numpy as np

from safe_wrappers import info as keys

_SUMS: Final = (
    keys.COST,
    keys.COST_SUBSTEP,
    keys.COLLISIONS,
    keys.ADAPTION_PENALTY,
    keys.ADAPTION_TASK_REWARD,
    keys.OCCLUSION_PENALTY,
    keys.OCCLUSION_TASK_REWARD,
    keys.CONTACT_IMPULSE,
    keys.TELEOP_LOST,
    keys.TELEOP_LATE,
)
_LEASE_BOOLS: Final = (keys.LEASE_EXPIRED, keys.LEASE_REFUSED, keys.LEASE_BRAKING)
_ANY: Final = (
    *keys.CBF_BOOLS,
    keys.CBF_REFUSED,
    keys.SLIP_LIMITED,
    *_LEASE_BOOLS,
    keys.FAULT_ACTIVE,
    keys.OCCLUSION_EXPIRED,
    keys.CONTACT_PARTIAL,
    keys.TELEOP_REVOKED,
    keys.BALANCE_PARTIAL,
)
_CONTACT_PEAKS: Final = (keys.CONTACT_PEAK_FORCE, keys.CONTACT_PENETRATION, keys.CONTACT_RESIDUAL)
_LARGEST: Final = (
    keys.CBF_CORRECTION,
    keys.CBF_CLIPPED,
    keys.SPIN_OUT,
    *_CONTACT_PEAKS,
    keys.BALANCE_FRICTION_USED,
)
_SMALLEST: Final = (keys.CBF_MARGIN, keys.TELEOP_CLEARANCE_M)
_MEANS: Final = (keys.BALANCE_SUPPORTED, keys.BALANCE_AIRBORNE)


def macro_info(infos: list[dict[str, Any]]) -> dict[str, Any]:
    """The last control step's info, in which costs are summed up and no intervention of the others is lost.

    Costs, collisions, impulses, packets lost or late, and what `AdaptionPenalty` and `OcclusionPenalty` say of the
    reward, are sums; what is a flag is True if it was at any control step; corrections, contact forces, used friction
    and a spin-out are the largest, the margin and a channel's clearance are the smallest, and so is the zero moment
    point's, over the control steps that have one; `BalanceMonitor`'s shares are means. Everything else is the last
    control step's: the running counts of `RecordInterventions`, momentum, and which tracks are seen, how uncertain
    they are. A key that only some control steps have counts where it is there.
    """
    last = infos[-1]
    if len(infos) == 1:
        return last
    if keys.BALANCE_ZMP_MARGIN in last:
        margins = [i[keys.BALANCE_ZMP_MARGIN] for i in infos if i.get(keys.BALANCE_SUPPORTED)]
        last[keys.BALANCE_ZMP_MARGIN] = min(margins, default=0.0)
    merges = ((_SUMS, np.sum), (_ANY, np.any), (_LARGEST, np.max), (_SMALLEST, np.min), (_MEANS, np.mean))
    for names, merge in merges:
        for name in names:
            values = [info[name] for info in infos if name in info]
            if values:
                merged = merge(values, axis=0)
                array = isinstance(values[-1], np.ndarray)
                last[name] = np.asarray(merged, values[-1].dtype) if array else type(values[-1])(merged)
    return last
