"""What a picture's CSV file holds against what is drawn on its axes."""

import csv

import numpy as np
import pytest
from made_up import fill, steps
from matplotlib.figure import Figure
from matplotlib.patches import Circle, StepPatch

from safe_wrappers.train.evaluation.curves import Curve
from safe_wrappers.train.evaluation.scene import Scene
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.figures import (
    constraints,
    corrections,
    curve,
    finals,
    plane,
    scenes,
    timelines,
    where,
)
from safe_wrappers.train.figures.picture import Plotted
from safe_wrappers.train.figures.plot_files import PlotFiles

ARMS = ["bare", "safe"]


@pytest.fixture
def drawn(monkeypatch):
    """The axes of every picture that is made, by its name."""
    kept = {}

    def keep(name, alt, paint, height=0.0):
        kept[name] = Figure().subplots()
        paint(kept[name])
        return "<svg></svg>"

    for module in (
        constraints, corrections, curve, finals, plane, scenes, timelines, where,
    ):  # fmt: skip
        monkeypatch.setattr(module, "draw", keep)
    return kept


def column(rows, name, **of):
    """A column of the rows that are of something."""
    return [row[name] for row in rows if all(row[key] == value for key, value in of.items()) and name in row]


def flags(count, every):
    return np.arange(count) % every == 0


def test_a_file_holds_every_row_and_only_finite_numbers(tmp_path):
    files = PlotFiles(tmp_path / "my page.html")
    rows = [{"a": "x, y", "b": 0.1}, {"a": "z", "b": float("nan")}, {"a": "w", "b": float("inf")}]
    assert files.link(Plotted("one-0", ("a", "b"), rows)) == "my%20page_data/one-0.csv"
    assert not list(tmp_path.iterdir())
    files.write()
    with (tmp_path / "my page_data" / "one-0.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [["a", "b"], ["x, y", "0.1"], ["z", ""], ["w", ""]]


def test_a_page_without_a_picture_has_no_folder(tmp_path):
    PlotFiles(tmp_path / "page.html").write()
    assert not list(tmp_path.iterdir())


def test_a_curve(drawn):
    seeds = np.random.default_rng(0).normal(size=(2, 20))
    lines = Curve(
        np.linspace(5, 95, 20), seeds.mean(axis=0), seeds.min(axis=0), seeds.max(axis=0), seeds, (3, 7)
    )
    rows = curve.curve_picture("c", "Return", "return", {"bare": None, "safe": lines}, ARMS).data.rows
    shown = drawn["c"].lines
    assert len(shown) == 3
    for line, what in zip(shown, ("seed 3", "seed 7", "mean"), strict=True):
        assert column(rows, "training_steps", arm="safe", what=what) == list(line.get_xdata())
        assert column(rows, "value", arm="safe", what=what) == list(line.get_ydata())
    band = drawn["c"].collections[0].get_paths()[0].vertices[:, 1]
    assert set(column(rows, "value", what="low") + column(rows, "value", what="high")) == set(band)
    assert len(rows) == 5 * 20


def test_the_sizes_of_corrections(drawn):
    changed = flags(200, 3)
    sizes = np.where(changed, np.linspace(0.1, 2.0, 200), 0).astype(np.float32)
    logs = {"bare": steps(), "safe": steps(intervened=changed, correction=sizes)}
    rows = corrections.corrections_picture(logs, ARMS).data.rows
    outline = drawn["corrections"].patches[-1].get_xy()
    assert column(rows, "from") == list(outline[0:-2:2, 0])
    assert column(rows, "steps") == [*outline[1:-1:2, 1]]
    assert sum(column(rows, "steps")) == changed.sum()
    assert set(column(rows, "arm")) == {"safe"}


def test_constraints(drawn):
    refused = np.column_stack([flags(200, 4), flags(200, 10)])
    log = steps(refused=refused, constraint_names=np.array(["Reach<1>", "Speed"]))
    rows = constraints.constraints_picture({"bare": log, "safe": log}, ARMS).data.rows
    widths = [bar.get_width() for bar in drawn["constraints"].patches]
    assert column(rows, "percent_of_steps") == widths == [25.0, 10.0] * 2
    assert column(rows, "constraint", arm="safe") == ["Reach<1>", "Speed"]


@pytest.mark.parametrize(
    ("picture", "name", "value"),
    [
        (timelines.changes_picture, "episode-changes", "percent_of_steps"),
        (timelines.failures_picture, "episode-failures", "per_1000_steps"),
    ],
)
def test_when_in_an_episode(drawn, picture, name, value):
    log = steps(intervened=flags(200, 3), infeasible=flags(200, 5), fallback=flags(200, 7))
    rows = picture({"bare": log, "safe": log}, ARMS).data.rows
    stairs = [patch.get_data() for patch in drawn[name].patches if isinstance(patch, StepPatch)]
    assert column(rows, value) == [height for each in stairs for height in each.values]
    assert column(rows, "from_step") == [edge for each in stairs for edge in each.edges[:-1]]
    assert column(rows, "to_step") == [edge for each in stairs for edge in each.edges[1:]]
    assert len(set(zip(column(rows, "arm"), column(rows, "event"), strict=True))) == len(stairs)


def test_when_in_training(drawn):
    rate = (np.linspace(0, 100, 5), np.array([1.0, np.nan, 3.0, 0.0]), 4)
    rates = {"infeasible": {"safe": rate}, "fallback": {"safe": (rate[0], 2 * rate[1], 8)}}
    rows = timelines.training_timeline_picture(rates, 400, ARMS).data.rows
    stairs = [patch.get_data() for patch in drawn["training-timeline"].patches]
    assert len(stairs) == 2
    for event, each in zip(("infeasible", "fallback"), stairs, strict=True):
        np.testing.assert_array_equal(column(rows, "per_1000_steps", event=event), each.values)
        np.testing.assert_array_equal(column(rows, "from_step", event=event), each.edges[:-1])


@pytest.fixture
def numbers(fake_experiment):
    """A whole comparison in which the seeds differ."""
    experiment = fake_experiment()
    fill(experiment, {"return": 20, "cost": 4}, {"return": 10, "cost": 1})
    summary = summarize(experiment)
    for row in summary.per_seed:
        row["return"] += row["seed"]
    return summary


def test_finals(drawn, numbers):
    rows = finals.finals_picture(
        "f", "Return", "return", "return", numbers, ["unfiltered", "filtered"]
    ).data.rows
    dots = [x for each in drawn["f"].collections if len(x := each.get_offsets()[:, 0]) == 2]
    assert len(dots) == 4
    of_seeds = [row["return"] for row in rows if row["what"].startswith("seed")]
    assert of_seeds == [float(x) for each in dots for x in each]
    assert column(rows, "return", arm="filtered", filter="on", what="seed 1") == [11.0]
    assert column(rows, "return", what="mean") == [20, 10, 20, 10]


def test_the_plane(drawn, numbers):
    rows = plane.plane_picture(numbers, ["unfiltered", "filtered"]).data.rows
    offsets = [each.get_offsets() for each in drawn["plane"].collections if hasattr(each, "get_sizes")]
    large = [tuple(map(float, each[0])) for each in offsets if len(each) == 1 and each[0].any()]
    means = [(row["return"], row["cost"]) for row in rows if row["what"] == "mean"]
    assert sorted(means) == sorted(large)
    small = sorted(tuple(map(float, point)) for each in offsets if len(each) == 2 for point in each)
    assert small == sorted((row["return"], row["cost"]) for row in rows if row["what"].startswith("seed"))


def test_where(drawn):
    log = steps(count=400, intervened=flags(400, 3))
    view = where.choose_view(log, None)
    data = where.where_picture("w", "Where", log, view, "intervened").data
    shown, visited = drawn["w"].collections[-1], drawn["w"].collections[0]
    x, y = data.columns[:2]
    assert {x, y} <= {"x (m)", "y (m)", "speed (m/s)"}
    hexagons = [row for row in data.rows if row["share"] > 0]
    np.testing.assert_array_equal([(row[x], row[y]) for row in hexagons], shown.get_offsets())
    np.testing.assert_allclose(np.sqrt([row["share"] for row in hexagons]), shown.get_facecolor()[:, 3])
    assert len(data.rows) == len(visited.get_offsets())
    assert sum(row["steps"] for row in data.rows) <= 400
    flagged = sum(row["steps"] * row["share"] for row in data.rows)
    low, high = np.array(view.extent).reshape(2, 2).T
    places = log.coordinates[:, (view.x, view.y)]
    inside = ((places >= low) & (places <= high)).all(axis=1)
    assert flagged == pytest.approx((log.intervened & inside).sum())


def test_an_episode_from_above(drawn):
    scene = Scene(
        agent=np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.2]]),
        goals=np.array([[1.0, 1.0]]),
        hazards=np.array([[0.5, 0.1], [2.0, 2.0]]),
        vases=np.array([[-1.0, 0.0]]),
        goal_radius=0.3,
        hazard_radius=0.2,
        intervened=np.array([False, True]),
        violated=np.array([True, False]),
    )
    rows = scenes.scene_picture("s", "From above", scene, 0, scenes.scene_frame(scene)).data.rows
    axes = drawn["s"]
    path = [(row["x_m"], row["y_m"]) for row in rows if row["what"] == "path"]
    np.testing.assert_array_equal(path, axes.lines[0].get_xydata())
    circles = [(*each.center, each.radius) for each in axes.patches if isinstance(each, Circle)]
    assert circles == [(row["x_m"], row["y_m"], row["radius_m"]) for row in rows if "radius_m" in row]
    for name, marks in zip(("changed", "violated"), axes.collections, strict=True):
        marked = [(row["x_m"], row["y_m"]) for row in rows if row.get(name)]
        np.testing.assert_array_equal(marked, marks.get_offsets())
    assert "changed" not in rows[-1]  # no step came after it
