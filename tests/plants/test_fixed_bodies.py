"""What no force can move: the world, what is welded to it, and what is moved by hand with all that it carries."""

import mujoco
import numpy as np

from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n

XML = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
<body name="shelf"><geom size=".1"/></body>
<body name="hand" mocap="true"><geom size=".1" mass="50"/><body name="ring"><geom size=".1" mass="50"/></body></body>
<body name="held" pos="0 0 1"><joint name="swing" type="hinge"/><geom size=".1" mass="1"/>
<body name="tip"><geom size=".1" mass="2"/></body></body></worldbody>
<actuator><motor joint="swing" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_the_world_mocap_bodies_and_what_is_welded_to_either():
    model = mujoco.MjModel.from_xml_string(XML)
    names = ["world", "shelf", "hand", "ring", "held", "tip"]
    assert [model.body(name).id for name in names] == list(range(6))
    assert fixed_bodies(model).tolist() == [True, True, True, True, False, False]


def test_a_hand_that_is_moved_by_the_env_is_no_weight():
    assert np.isclose(weight_n(mujoco.MjModel.from_xml_string(XML)), 3.0 * 9.81)
