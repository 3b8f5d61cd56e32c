"""The pictures: their sentences against planted numbers, and what they are drawn from."""

import base64
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import steps

from safe_wrappers.train.evaluation.summary import Curve
from safe_wrappers.train.report.figures import curve_picture, place_pictures, refusals, telling_pair

ARMS = ["bare", "safe"]


def texts(picture):
    """What is written in a drawing."""
    kind, data = picture.image.split(",")
    assert kind == "data:image/svg+xml;base64"
    root = ElementTree.fromstring(base64.b64decode(data))
    return {"".join(node.itertext()) for node in root.iter() if node.tag.endswith("text")}


def flags(count, *where):
    chosen = np.zeros(count, dtype=bool)
    for part in where:
        chosen[part] = True
    return chosen


def test_which_constraint_refused_and_how_much():
    refused = np.column_stack([flags(200, slice(0, 20)), flags(200, slice(10, 50)), flags(200)])
    names = np.array(["JointSpeedLimit", "Clearance<2>", "Workspace"])
    sizes = np.where(flags(200, slice(0, 50)), np.linspace(0.1, 2.0, 200), 0).astype(np.float32)
    log = steps(refused=refused, constraint_names=names, intervened=sizes > 0, correction=sizes)
    said = refusals({"safe": log}).reading
    assert said.startswith(
        "“safe”: of 200 actions refused by Clearance<2> 20 %, JointSpeedLimit 10 %. Never acted: Work"
    )
    assert (
        f"Half of its 50 corrections were below {np.median(sizes[:50]):.3g}, the largest {sizes[:50].max():.3g}"
        in said
    )
    assert "refused by no constraint. Never acted: Clearance" in refusals({"safe": steps()}).reading


def test_where_in_state_space():
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    inside = np.hypot(places[:, 0] - 0.5, places[:, 2]) < 0.2  # a disc at x = 0.5, speed = 0
    log = steps(4000, coordinates=places, intervened=inside)
    bare = steps(4000, coordinates=places, violated=np.hypot(places[:, 0] - 0.5, places[:, 2]) < 0.1)
    hurt, picture = place_pictures("safe", log, "bare", bare)
    assert picture.reading.startswith(
        f"{100 * inside.mean():.2g} % of 4,000 steps were changed; in the middle"
    )
    assert hurt.title == "Where violations were: bare, filter off" and "were in violation" in hurt.reading
    assert {"x (m)", "speed (m/s)", "share of steps changed"} <= texts(picture)
    (nowhere,) = place_pictures("safe", steps(), "bare", None)
    assert nowhere.reading == "Nowhere: none of 200 steps were changed."
    (everywhere,) = place_pictures("safe", steps(intervened=flags(200, slice(None))), "bare", None)
    assert everywhere.reading == "Everywhere: all of 200 steps were changed."
    one = steps(intervened=flags(200, 0), coordinates=np.zeros((200, 1)), coordinate_names=np.array(["x"]))
    assert "fewer than two coordinates" in place_pictures("safe", one, "bare", None)[0].reading
    still = steps(
        intervened=flags(200, 0), coordinates=np.zeros((200, 2)), coordinate_names=np.array(["x", "y"])
    )
    assert place_pictures("safe", still, "bare", None)[0].image


NOISE = np.random.default_rng(1).normal(size=(3000, 6))
PLANTED = {
    "a ring": lambda a, b: np.abs(np.hypot(a, b) - 1.0) < 0.25,
    "opposite corners": lambda a, b: a * b > 0.5,
    "a corner": lambda a, b: (a > 1.0) & (b < -0.5),
}


@pytest.mark.parametrize("planted", PLANTED)
@settings(max_examples=8)
@given(columns=st.permutations(range(6)))
def test_the_planted_pair_is_found_wherever_it_is_in_any_unit(planted, columns):
    a, b = columns[:2]
    chosen = PLANTED[planted](NOISE[:, a], NOISE[:, b])
    assert telling_pair(np.exp(NOISE) * 1e4, chosen) == (min(a, b), max(a, b))


def test_many_steps_are_thinned_but_rare_flags_are_kept():
    coordinates = np.random.default_rng(0).normal(size=(60_000, 2))
    assert telling_pair(coordinates, flags(60_000, 1)) == (0, 1)  # thinning by three would leave none


def test_a_learning_curve():
    seeds = np.array([np.linspace(0, 10, 20), np.linspace(0, 30, 20)])
    curve = Curve(np.arange(20.0), seeds.mean(axis=0), seeds[0], seeds[1], seeds)
    picture = curve_picture("Return", "return", {"bare": curve, "safe": None}, ARMS)
    assert picture.reading == "From the first to the last tenth of training: “bare” 0.526 to 19.5."
    assert {"bare", "training steps", "return"} <= texts(picture)
    assert curve_picture("Return", "return", {"safe": None}, ARMS).image == ""
