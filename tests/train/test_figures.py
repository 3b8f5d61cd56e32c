"""Every picture: its sentence against planted numbers, and well-formed SVG that takes the page's colours."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from made_up import fill, steps

from safe_wrappers.train.evaluation.curves import Curve, event_rate
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.figures.canvas import draw
from safe_wrappers.train.figures.constraints import constraints_picture
from safe_wrappers.train.figures.corrections import corrections_picture
from safe_wrappers.train.figures.curve import curve_picture
from safe_wrappers.train.figures.finals import finals_picture
from safe_wrappers.train.figures.plane import plane_limits, plane_picture
from safe_wrappers.train.figures.timelines import (
    changes_picture,
    failures_picture,
    training_timeline_picture,
)
from safe_wrappers.train.figures.where import choose_view, where_picture

ARMS = ["bare", "safe"]
DRAWN = 'role="img" aria-label="'


def check(picture):
    """What holds for every drawing."""
    root = ElementTree.fromstring(picture.svg)
    label = root.attrib["aria-label"]
    assert picture.title in label and picture.reading in label
    assert not re.search(r"#0[0-9a]0[0-9a]0[0-9a]|https?:|<metadata|xmlns", picture.svg)
    assert all(look in ("fill", "line", "dot", "ring", "disc") for _, look in picture.keys.values())
    return root


def texts(root):
    return ["".join(node.itertext()) for node in root.iter() if node.tag.endswith("text")]


def flags(count, *where):
    chosen = np.zeros(count, dtype=bool)
    for part in where:
        chosen[part] = True
    return chosen


def test_a_label_is_escaped():
    svg = draw("x", 'a "quoted" <b> & c', lambda axes: None)
    assert 'aria-label="a &quot;quoted&quot; &lt;b&gt; &amp; c"' in svg
    assert ElementTree.fromstring(svg).attrib["aria-label"] == 'a "quoted" <b> & c'


def test_corrections():
    changed = flags(200, slice(0, 50))
    sizes = np.where(changed, np.linspace(0.1, 2.0, 200), 0).astype(np.float32)
    picture = corrections_picture({"safe": steps(intervened=changed, correction=sizes)}, ARMS)
    median, largest = np.median(sizes[:50]), sizes[:50].max()
    assert picture.reading == (
        f"The filter left 75 % of 200 steps as they were; of the 50 corrections half were below {median:.3g},"
        f" the largest {largest:.3g}."
    )
    check(picture)
    assert picture.keys == {"safe": ("arm1", "fill")}
    both = corrections_picture({"bare": steps(), "safe": steps(intervened=changed, correction=sizes)}, ARMS)
    assert both.reading.startswith(
        "“bare”: the filter changed none of 200 steps. “safe”: the filter left 75 %"
    )
    assert list(both.keys) == ["safe"]
    nothing = corrections_picture({"safe": steps()}, ARMS)
    assert (nothing.svg, nothing.reading) == ("", "The filter changed none of 200 steps.")


def test_constraints():
    refused = np.column_stack([flags(200, slice(0, 20)), flags(200, slice(10, 20), slice(50, 80))])
    log = steps(refused=refused, constraint_names=np.array(["JointSpeedLimit", "Clearance<2>"]))
    picture = constraints_picture({"safe": log}, ARMS)
    assert picture.reading == (
        "Of 200 actions refused by Clearance<2> 20 %, JointSpeedLimit 10 %; in 5 % more than one did."
    )
    assert {"JointSpeedLimit", "Clearance<2>", "10 %", "20 %"} <= set(texts(check(picture)))
    alone = constraints_picture({"safe": steps(refused=refused[:, :1])}, ARMS)
    assert (alone.svg, alone.reading) == ("", "Of 200 actions refused by Clearance 10 %.")
    idle = constraints_picture({"safe": steps()}, ARMS).reading
    assert idle.startswith("No constraint refused any of 200 actions; never acted: Clearance (")
    names = np.array(["JointSpeedLimit", "Clearance<2>", "Upright"])
    one = steps(refused=np.column_stack([refused, flags(200)]), constraint_names=names)
    said = constraints_picture({"safe": one}, ARMS).reading
    assert "JointSpeedLimit 10 %" in said and "; never acted: Upright (" in said and "Upright 0 %" not in said
    silent = steps(refused=np.zeros((200, 0), dtype=bool), constraint_names=np.array([], dtype=str))
    assert "does not say which" in constraints_picture({"safe": silent}, ARMS).reading


def test_when_in_an_episode():
    log = steps(
        intervened=flags(200, slice(0, 10), slice(100, 110)),
        infeasible=flags(200, 3),
        fallback=flags(200, 3, 4),
    )
    changes = changes_picture({"safe": log}, ARMS)
    assert changes.reading == "Of 200 steps 20 were changed."
    check(changes)
    assert changes.keys == {"safe": ("arm1", "line")}
    failures = failures_picture({"safe": log, "bare": steps()}, ARMS)
    assert failures.reading == (
        "“safe”: of 200 steps 1 were infeasible and 2 ran the fallback. “bare”: of 200 steps 0 were infeasible"
        " and 0 ran the fallback."
    )
    # Steps 0 to 4 of two episodes: one of ten is 100 of 1000.
    assert "200" in texts(check(failures))
    assert failures.keys == {"safe: infeasible": ("arm1", "line"), "safe: fallback": ("arm1", "dot")}
    for quiet in (changes_picture({"safe": steps()}, ARMS), failures_picture({"safe": steps()}, ARMS)):
        assert quiet.svg == ""
        assert quiet.reading.startswith("Of 200 steps 0 were ")


def test_where_in_state_space():
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    inside = np.hypot(places[:, 0] - 0.5, places[:, 2]) < 0.2  # a disc at x = 0.5, speed = 0
    log = steps(4000, coordinates=places, intervened=inside)
    bare = steps(4000, coordinates=places, violated=np.hypot(places[:, 0] - 0.5, places[:, 2]) < 0.1)
    view = choose_view(log, bare)
    assert (view.x, view.y) == (0, 2)
    left, right, low, high = view.extent
    # The disc and about as much around it.
    assert (left, right, low, high) == pytest.approx((0.1, 0.9, -0.4, 0.4), abs=0.05)
    picture = where_picture("where", "Where", log, view, "intervened")
    assert picture.reading.startswith(f"{100 * inside.mean():.2g} % of 4,000 steps were changed, in ")
    x, y = map(float, re.search(r"near \((.*), (.*)\)", picture.reading).groups())
    assert np.hypot(x - 0.5, y) < 0.25
    root = check(picture)
    assert {"x (m)", "speed (m/s)"} <= set(texts(root))
    assert "var(--mark)" in picture.svg and "var(--bad)" not in picture.svg
    hurt = where_picture("hurt", "Hurt", bare, view, "violated")
    assert "were in violation" in hurt.reading
    assert "var(--bad)" in hurt.svg
    quiet = where_picture("quiet", "Quiet", steps(4000, coordinates=places), view, "violated")
    assert quiet.reading == "None of 4,000 steps was in violation."


def test_a_place_needs_something_to_tell_apart():
    assert choose_view(steps(), None) is None
    assert choose_view(steps(intervened=np.ones(200, dtype=bool)), None) is None
    one = steps(intervened=flags(200, 0), coordinates=np.zeros((200, 1)), coordinate_names=np.array(["x"]))
    assert choose_view(one, None) is None
    still = steps(
        intervened=flags(200, 0), coordinates=np.zeros((200, 2)), coordinate_names=np.array(["x", "y"])
    )
    check(where_picture("still", "Still", still, choose_view(still, None), "intervened"))


@pytest.fixture
def summary(fake_experiment):
    def make(off, on):
        experiment = fake_experiment()
        fill(experiment, off, on)
        return summarize(experiment)

    return make


def test_return_against_cost(summary):
    numbers = summary({"return": 20, "cost": 50}, {"return": 10})
    picture = plane_picture(numbers, ["unfiltered", "filtered"])
    assert picture.reading == " ".join(
        f"“{arm}”: putting the filter on took the cost from 50 to 0 and the return from 20 to 10."
        for arm in ("unfiltered", "filtered")
    )
    check(picture)
    assert picture.keys["filtered, filter off"] == ("arm1", "ring")
    assert picture.keys["filtered, filter on"] == ("arm1", "disc")
    other = summary({"return": 500, "cost": 0}, {"return": -500})
    ((left, right), (low, high)) = plane_limits([numbers, other])
    assert left < -500 < 500 < right
    assert low < 0 < 50 < high
    assert "−400" in texts(
        check(plane_picture(numbers, ["unfiltered", "filtered"], limits=plane_limits([other])))
    )
    assert plane_picture(numbers, []).svg == ""


def test_what_came_out(summary):
    numbers = summary({"return": 20}, {"return": 10})
    picture = finals_picture(
        "f", "Return", "return per episode", "return", numbers, ["unfiltered", "filtered"]
    )
    assert picture.reading == (
        "From 10 (unfiltered, filter on) to 20 (unfiltered, filter off). 2 seeds; the bar is their range."
    )
    root = check(picture)
    assert {"unfiltered, off", "filtered, on", "return per episode"} <= set(texts(root))
    assert picture.svg.count('<g id="f-PathCollection_') == 4  # the dots of each row's seeds
    zero = finals_picture("z", "Cost", "cost", "cost", numbers, ["unfiltered", "filtered"])
    assert zero.reading.startswith("0 everywhere.")


def test_a_learning_curve_shows_its_seeds():
    seeds = np.array([np.linspace(0, 10, 20), np.linspace(0, 30, 20)])
    curve = Curve(np.arange(20.0), seeds.mean(axis=0), seeds[0], seeds[1], seeds, (3, 7))
    picture = curve_picture("c", "Return", "return", {"bare": curve, "safe": None}, ARMS)
    root = check(picture)
    lines = [g for g in root.iter() if g.attrib.get("id", "").startswith("c-line2d")]
    drawn = [g for g in lines if "var(--arm0)" in ElementTree.tostring(g).decode()]
    assert len(drawn) == 3  # two seeds and the mean
    assert picture.reading == "From the first to the last tenth of training: 0.526 to 19.5."
    assert curve_picture("c", "Return", "return", {"safe": None}, ARMS).svg == ""


def test_when_in_training(fake_experiment):
    experiment = fake_experiment()
    fill(experiment, {}, {"infeasible": 2})
    arm = experiment.arms[1]
    edges, rates, count = event_rate(experiment, arm, "infeasible")
    assert count == 2 * 10 * 2  # an episode's, ten episodes, two seeds
    assert (edges[0], edges[-1]) == (0, 1000)
    assert np.nanmin(rates) == np.nanmax(rates) == 20.0  # 2 of 100 steps
    fallback = event_rate(experiment, arm, "fallback")
    picture = training_timeline_picture(
        {"infeasible": {"safe": (edges, rates, count)}, "fallback": {"safe": fallback}}, 2000, ARMS
    )
    assert picture.reading == "Of 2,000 training steps 40 were infeasible and 0 ran the fallback."
    check(picture)
    assert picture.keys == {"safe: infeasible": ("arm1", "line")}
    none = training_timeline_picture(
        {"infeasible": {"safe": fallback}, "fallback": {"safe": fallback}}, 2000, ARMS
    )
    assert none.svg == ""
    assert none.reading == "None: in 2,000 training steps none was infeasible and none ran the fallback."
    (experiment.run_folder(arm, 0) / "episodes.csv").unlink()
    (experiment.run_folder(arm, 1) / "episodes.csv").unlink()
    assert event_rate(experiment, arm, "infeasible") is None
