"""Random MJCF: one model per seed, of whatever MuJoCo's XML has that bears on motion.

Most models have only actuators that are affine in their controls, and default flags, so that they get as far as a
closed loop; the rest draw from everything.
"""

import random
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Final

Element = ET.Element

_AFFINE: Final = ("motor", "position", "velocity", "damper", "general")
_OTHER: Final = ("intvelocity", "cylinder", "muscle", "adhesion", "dcmotor", "general")
_DISABLE: Final = (
    *("actuation", "autoreset", "clampctrl", "constraint", "contact", "damper", "equality", "eulerdamp"),
    *("filterparent", "frictionloss", "gravity", "island", "limit", "midphase", "multiccd", "nativeccd"),
    *("refsafe", "sensor", "spring", "warmstart"),
)
_ENABLE: Final = ("diagexact", "energy", "fwdinv", "invdiscrete", "override", "sleep")


class RandomModel:
    """Draws one model; `xml` is its text."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._odd = self._share(0.3)  # such models draw from everything
        self._root = ET.Element("mujoco", model=f"random {seed}")
        # Names so far: of hinges and slides ("scalar"), of spheres and cylinders ("rounds").
        self._bodies, self._moving, self._mocap = list[str](), list[str](), list[str]()
        self._scalar, self._balls = list[str](), list[str]()
        self._rounds, self._sites, self._tendons = list[str](), list[str](), list[str]()
        self._options()
        mesh = {"name": "wedge", "vertex": "0 0 0 .2 0 0 0 .2 0 0 0 .2"}
        ET.SubElement(ET.SubElement(self._root, "asset"), "mesh", **mesh)
        self._world()
        self._equalities()
        self._tendon_section()
        self._actuators()
        self.xml: str = ET.tostring(self._root, encoding="unicode")

    def _share(self, share: float) -> bool:
        return self._random.random() < share

    def _uniform(self, low: float, high: float, count: int = 1) -> str:
        return " ".join(f"{self._random.uniform(low, high):.4g}" for _ in range(count))

    def _pick(self, options: Sequence[str], weights: Sequence[float] | None = None) -> str:
        return self._random.choices(options, weights)[0]

    def _range(self, low: float, high: float) -> str:
        ends = sorted(self._random.uniform(low, high) for _ in range(2))
        return f"{ends[0]:.4g} {ends[1]:.4g}"

    def _maybe(self, share: float, **attributes: str) -> dict[str, str]:
        """Each of the attributes with this probability."""
        return {name: value for name, value in attributes.items() if self._share(share)}

    def _options(self) -> None:
        angle = self._pick(("radian", "degree"))
        compiler = ET.SubElement(self._root, "compiler", angle=angle, balanceinertia="true")
        compiler.attrib |= self._maybe(0.2, boundmass="0.01", boundinertia="0.001")
        option = ET.SubElement(self._root, "option")
        option.set("timestep", self._pick(("0.001", "0.002", "0.005", "0.01", "0.02", "0.0013")))
        option.set("integrator", self._pick(("Euler", "RK4", "implicit", "implicitfast"), (4, 1, 1, 2)))
        option.attrib |= self._maybe(
            0.3,
            cone=self._pick(("pyramidal", "elliptic")),
            solver=self._pick(("Newton", "CG", "PGS")),
            jacobian=self._pick(("dense", "sparse", "auto")),
            iterations=self._pick(("1", "5", "100")),
            gravity=self._pick(("0 0 0", "0 0 -9.81", "1 2 -5")),
        )
        fluid = {"density": "1.2", "viscosity": "0.1", "wind": self._uniform(-2, 2, 3)}
        option.attrib |= self._maybe(0.1, impratio="5", noslip_iterations="3", o_margin="0.01", **fluid)
        if not self._odd:
            return
        if self._share(0.1):
            option.set("actuatorgroupdisable", self._pick(("0", "1", "1 2")))
        flag = ET.SubElement(option, "flag")
        flag.attrib |= self._maybe(0.06, **dict.fromkeys(_DISABLE, "disable"))
        flag.attrib |= self._maybe(0.06, **dict.fromkeys(_ENABLE, "enable"))

    def _world(self) -> None:
        world = ET.SubElement(self._root, "worldbody")
        if self._share(0.6):
            ET.SubElement(world, "geom", name="floor", type="plane", size="5 5 .1")
        for i in range(self._random.randint(0, 2)):
            self._geom(world, f"wall{i}")
        if self._share(0.3):
            self._site(world, "anchor")
        nodes = [world]
        for i in range(self._random.randint(1, 6)):
            parent = world if self._share(0.3) else self._random.choice(nodes)
            nodes.append(self._body(parent, f"body{i}", parent is world))
        if self._share(0.15):
            mocap = ET.SubElement(world, "body", name="mocap", mocap="true", pos=self._uniform(-1, 1, 3))
            self._geom(mocap, "mocap_geom")
            self._mocap.append("mocap")
        if self._odd and self._share(0.06):
            flex = {"type": "grid", "count": "3 3 1", "spacing": ".1 .1 .1", "radius": ".02", "mass": "0.3"}
            cloth = ET.SubElement(world, "flexcomp", name="cloth", pos="0 0 1.5", dim="2", **flex)
            ET.SubElement(cloth, "edge", equality="true")

    def _body(self, parent: Element, name: str, of_world: bool) -> Element:
        body = ET.SubElement(parent, "body", name=name, pos=self._uniform(-0.4, 0.4, 3))
        if of_world:
            body.set("pos", f"{self._uniform(-1, 1, 2)} {self._uniform(0.3, 2)}")
        body.attrib |= self._maybe(0.3, quat=self._uniform(-1, 1, 4))
        body.attrib |= self._maybe(0.1, gravcomp=self._uniform(0, 1.5))
        kinds = ("hinge", "slide", "ball", "free", "fixed", "many")
        kind = self._pick(kinds, (6, 3, 1, 1.5 if of_world else 0, 1, 1))
        if kind == "free":
            ET.SubElement(body, "freejoint", name=f"{name}_free")
        elif kind == "many":
            joints = [self._pick(("slide", "hinge")) for _ in range(self._random.randint(1, 3))]
            for i, each in enumerate(joints):
                self._joint(body, f"{name}_joint{i}", each)
        elif kind != "fixed":
            self._joint(body, f"{name}_joint", kind)
        for i in range(self._pick(("", "1", "11"), (1, 8, 2)).count("1")):
            self._geom(body, f"{name}_geom{i}")
        if self._share(0.1) or (body.find("geom") is None and self._share(0.8)):
            inertial = {"pos": self._uniform(-0.1, 0.1, 3), "mass": self._uniform(0.05, 2)}
            ET.SubElement(body, "inertial", **inertial, diaginertia=".02 .03 .04")
        self._site(body, f"{name}_site")
        self._bodies.append(name)
        if kind != "fixed":
            self._moving.append(name)
        return body

    def _joint(self, body: Element, name: str, kind: str) -> None:
        joint = ET.SubElement(body, "joint", type=kind, axis=self._uniform(-1, 1, 3))
        if self._share(0.95):
            joint.set("name", name)
            (self._balls if kind == "ball" else self._scalar).append(name)
        if self._share(0.4):
            joint.set("range", "0 1.2" if kind == "ball" else self._range(-2, 2))
        joint.attrib |= self._maybe(
            0.3, damping=self._uniform(0, 1), armature=self._uniform(0, 0.3), pos=self._uniform(-0.1, 0.1, 3)
        )
        joint.attrib |= self._maybe(
            0.1, stiffness=self._uniform(0, 5), frictionloss=self._uniform(0, 0.5), margin="0.01"
        )
        if kind != "ball":
            joint.attrib |= self._maybe(
                0.1, ref=self._uniform(-1, 1), springref=self._uniform(-1, 1), actuatorgravcomp="true"
            )
            joint.attrib |= self._maybe(0.05 * self._odd, actuatorfrcrange=self._range(-3, 3))

    def _geom(self, body: Element, name: str) -> None:
        kind = self._pick(("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"), (4, 4, 1, 2, 3, 0.5))
        sizes = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "mesh": 0}[kind]
        geom = ET.SubElement(body, "geom", name=name, type=kind, pos=self._uniform(-0.3, 0.3, 3))
        if sizes:
            geom.set("size", self._uniform(0.03, 0.2, sizes))
        else:
            geom.set("mesh", "wedge")
        if self._share(0.3):
            geom.set("mass", self._uniform(0.01, 3))
        geom.attrib |= self._maybe(0.2, contype="0", conaffinity=self._pick(("0", "1")))
        contact = {"condim": self._pick(("1", "3", "4", "6")), "friction": self._uniform(0, 1, 3)}
        geom.attrib |= self._maybe(0.1, margin="0.02", gap="0.01", solref="0.01 1", priority="1", **contact)
        if kind in ("sphere", "cylinder"):
            self._rounds.append(name)

    def _site(self, body: Element, name: str) -> None:
        ET.SubElement(body, "site", name=name, pos=self._uniform(-0.3, 0.3, 3))
        self._sites.append(name)

    def _equalities(self) -> None:
        section = ET.SubElement(self._root, "equality")
        for _ in range(self._pick(("", "1", "11"), (7, 2, 1)).count("1")):
            active = {} if self._share(0.7) else {"active": "false"}
            kind = self._pick(("connect", "weld", "joint"))
            if kind == "joint" and self._scalar:
                ends = self._random.sample(self._scalar, min(len(self._scalar), self._random.randint(1, 2)))
                named = {f"joint{i + 1}": end for i, end in enumerate(ends)}
                ET.SubElement(section, "joint", polycoef=self._uniform(-0.5, 0.5, 5), **named, **active)
            elif kind != "joint" and self._moving:
                ends = [self._random.choice(self._moving), self._random.choice([*self._bodies, *self._mocap])]
                named = {f"body{i + 1}": end for i, end in enumerate(dict.fromkeys(ends))}
                anchor = {"anchor": self._uniform(-0.2, 0.2, 3)} if kind == "connect" else {}
                ET.SubElement(section, kind, **named, **anchor, **active)

    def _tendon_section(self) -> None:
        section = ET.SubElement(self._root, "tendon")
        for i in range(self._pick(("", "1", "11"), (7, 2, 1)).count("1")):
            fixed = self._share(0.5)
            name, kind = f"tendon{i}", "fixed" if fixed else "spatial"
            between = self._range(-1, 1) if fixed else self._range(0, 2)
            own = {"stiffness": self._uniform(0, 20), "springlength": self._range(0, 1)}
            lost = {"damping": self._uniform(0, 1), "frictionloss": self._uniform(0, 0.3)}
            attributes = self._maybe(0.2, range=between, armature=self._uniform(0, 0.2), **own, **lost)
            attributes |= self._maybe(0.1 * self._odd, actuatorfrcrange=self._range(-2, 2))
            if fixed and self._scalar:
                tendon = ET.SubElement(section, kind, name=name, **attributes)
                for joint in self._random.sample(self._scalar, self._random.randint(1, len(self._scalar))):
                    ET.SubElement(tendon, "joint", joint=joint, coef=self._uniform(-2, 2))
            elif not fixed and len(self._sites) > 1:
                tendon = ET.SubElement(section, kind, name=name, **attributes)
                first, *others = self._random.sample(self._sites, min(len(self._sites), 3))
                ET.SubElement(tendon, "site", site=first)
                for other in others:
                    if self._rounds and self._share(0.3):
                        ET.SubElement(tendon, "geom", geom=self._random.choice(self._rounds))
                    ET.SubElement(tendon, "site", site=other)
            else:
                continue
            self._tendons.append(name)

    def _actuators(self) -> None:
        section = ET.SubElement(self._root, "actuator")
        for i in range(self._random.randint(0 if self._odd else 1, 4)):
            strange = self._odd and self._share(0.2)
            kind = self._pick(_OTHER if strange else _AFFINE)
            transmission = self._transmission(kind, strange)
            if transmission is None:
                continue
            actuator = ET.SubElement(section, kind, **transmission)
            if self._share(0.9):
                actuator.set("name", f"actuator{i}")
            self._drive(actuator, kind, strange)

    def _transmission(self, kind: str, strange: bool) -> dict[str, str] | None:
        if kind == "adhesion":
            return {"body": self._random.choice(self._bodies), "ctrlrange": "0 1"}
        name = self._pick(
            ("joint", "jointinparent", "tendon", "site", "slidercrank", "body"),
            (8, 1, 2, 1, strange, strange * (kind == "general")),
        )
        if name == "joint" and self._balls and self._share(0.3):
            return {"joint": self._random.choice(self._balls), "gear": self._uniform(-2, 2, 3)}
        if name in ("joint", "jointinparent") and self._scalar:
            joint = self._random.choice(self._scalar)
            return {name: joint, "gear": self._uniform(-3, 3)} if self._share(0.6) else {name: joint}
        if name == "tendon" and self._tendons:
            return {"tendon": self._random.choice(self._tendons)}
        if name == "site" and len(self._sites) > 1:
            site, reference = self._random.sample(self._sites, 2)
            refsite = self._maybe(0.4, refsite=reference) if kind in ("motor", "position", "general") else {}
            return {"site": site, "gear": self._uniform(-2, 2, 6), **refsite}
        if name == "slidercrank" and len(self._sites) > 1:
            crank, slider = self._random.sample(self._sites, 2)
            return {"cranksite": crank, "slidersite": slider, "cranklength": "0.5"}
        return {"body": self._random.choice(self._bodies)} if name == "body" else None

    def _drive(self, actuator: Element, kind: str, strange: bool) -> None:
        if kind == "damper":
            actuator.set("ctrlrange", f"0 {self._uniform(0.1, 3)}")
        elif kind != "adhesion" and self._share(0.8):
            ends = "-1 1", "-0.4 0.4", "0 1", "0.5 2", "-1e-6 1e-6", "-1e6 1e6", self._range(-3, 3)
            actuator.set("ctrlrange", self._pick(ends, (9, 3, 3, 1, 1, 1, 8)))
        if kind not in ("muscle", "damper", "adhesion", "dcmotor"):
            actuator.attrib |= self._maybe(0.05, ctrllimited="false")
        if kind != "dcmotor":
            actuator.attrib |= self._maybe(0.25, forcerange=self._range(-2, 2))
        actuator.attrib |= self._maybe(0.1, group=self._pick(("0", "1", "2")))
        if self._odd and self._share(0.05):
            actuator.attrib |= {"delay": "0.02", "nsample": "4"}
        if kind == "position":
            actuator.attrib |= self._maybe(0.7, kp=self._uniform(0.1, 50), kv=self._uniform(0, 3))
            actuator.attrib |= self._maybe(0.2 * self._odd, timeconst="0.1")
        elif kind in ("velocity", "damper"):
            actuator.attrib |= self._maybe(0.7, kv=self._uniform(0.1, 5))
        elif kind == "intvelocity":
            actuator.set("actrange", self._range(-1, 1))
        elif kind == "dcmotor":
            actuator.attrib |= {"motorconst": "0.1", "resistance": "1"}
        elif kind == "muscle":
            actuator.set("lengthrange", "0.1 1")
        elif kind == "general":
            self._general(actuator, strange)

    def _general(self, actuator: Element, strange: bool) -> None:
        gain, bias = self._pick(("fixed", "affine")), self._pick(("none", "affine"))
        if strange:
            dynamics = ("none", "integrator", "filter", "filterexact", "muscle", "user")
            actuator.set("dyntype", self._pick(dynamics))
            actuator.set("dynprm", "0.1 1 1")
            gain = self._pick(("fixed", "affine", "muscle", "user"))
            bias = self._pick(("none", "affine", "muscle", "user"))
            if "muscle" in (gain, bias):
                actuator.set("lengthrange", "0.1 1")
            actuator.attrib |= self._maybe(0.3, actlimited="true", actrange="-1 1", actearly="true")
        actuator.attrib |= {"gaintype": gain, "biastype": bias}
        actuator.set("gainprm", self._uniform(-5, 5, 3))
        actuator.set("biasprm", f"{self._uniform(-1, 1)} {self._uniform(-20, 0)} {self._uniform(-2, 0)}")
