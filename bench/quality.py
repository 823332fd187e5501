"""`bench quality`: how well the quality checks distinguish good from failed captures, on captures drawn by seed.

The loopback rig's brush, sheet and camera, without its real-time servers: every press is laid by `Brush.press` and
`Paper.lay` and photographed by `Scene.render`, as on the rig. What counts as a failure was fixed before any threshold
was chosen; between sound and failed lies a band that is not drawn at all.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import BenchError, Result, at_most, rounds_of
from brushloop.calibrate.board.pix2len import Plane, see_board
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.collect.photograph.checks import Failure, Photograph
from brushloop.collect.rig.config import PaperConfig, QualityConfig
from brushloop.collect.rig.paper import Patch, Sheet
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.brush.brush import BrushSpec, Flaw
from brushloop.drivers.sim.brush.drag import Waypoint
from brushloop.drivers.sim.brush.footprint import PX_PER_MM, Footprint
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import World

GOAL, FALSE_ALARMS_GOAL, SECONDS_GOAL = 0.95, 0.02, 0.06
"""Precision and recall of each failure; share of sound captures that are called anything else; seconds a capture."""
CAPTURES = 600
LABELS: tuple[Failure | None, ...] = (None, *Failure)
Called = Failure | None
"""What a capture was, or was called: None is sound."""
Gray = NDArray[np.uint8]
GOOD_SHARE = 0.4
"""Share of sound captures; the rest is spread evenly over the failures."""
INK = 0.3
"""Ink per area above which a patch of the sheet counts as inked, for the labels."""
FOREIGN_MM2 = 4.0
"""Somebody else's ink in the patch from which a capture is labelled `neighbour`."""
SPOTLESS_MM2 = 0.2
"""Ink up to which a patch is labelled blank; between the two it has no label."""
DRIP_MM = 3.5
"""Drops closer to the stroke than this are not drawn: they may as well be taken for a part of it."""
FLAWS: dict[Failure | None, tuple[Flaw, float]] = {
    Failure.FAINT: (Flaw.FAINT, 0.5),
    Failure.DRY: (Flaw.DRY, 0.9),
    Failure.SPLIT: (Flaw.SPLIT, 0.4),
    Failure.BENT: (Flaw.BENT, 0.5),
}
"""What the brush has, and from which severity on, up to 1."""
LOADS: dict[Failure | None, tuple[float, float]] = {Failure.FAINT: (0.4, 0.5), Failure.DRY: (0.06, 0.22)}
"""Or how little ink it has, in two fifths of these captures."""
HIDDEN_MM = 1.5
"""Length of a stroke that the frame must hide for the label `cut`."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One capture and the truth about it."""

    label: Failure | None
    """None = sound."""
    image: Gray
    before: Gray
    """The still before this press."""
    plane: Plane
    patch: Patch
    depth_mm: float
    sheet_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Blank:
    """A patch before a press, and whether there is ink in it."""

    blank: bool
    image: Gray
    plane: Plane
    patch: Patch


class Bench:
    """One sheet of one drawn rig: its own brush, light, noise and lens."""

    def __init__(self, seed: int, sheet: int) -> None:
        self.rng = np.random.default_rng([seed, sheet])
        self.world = World(draw_rig(self.rng))
        table = self.world.config.table
        self.sheet = Sheet(PaperConfig(origin_mm=table.origin_mm, touch_z_mm=table.paper_z_mm, size_mm=table.sheet_mm))
        self.table = table
        self._away = brush_pose(*self.world.config.home_mm)
        self._scene = Scene(self.world)
        self._board = BoardSpec(
            squares=table.board_squares,
            square_mm=table.board_square_mm,
            marker_mm=table.board_marker_mm,
            origin_mm=table.board_origin_mm,
        )
        self.still = self._scene.render(self._away)
        self.plane = see_board(self.still, self._board).plane
        self._presses = 0

    def samples(self) -> Iterator[Sample | Blank]:
        """A patch, then the press on it, patch by patch; patches that hold ink are passed over, as a session would."""
        for index in range(self.sheet.capacity):
            patch = self.sheet.patch(index)
            there = self.ink_mm2(patch)
            if there >= FOREIGN_MM2 or there <= SPOTLESS_MM2:
                yield Blank(there <= SPOTLESS_MM2, self.still, self.plane, patch)
            if there > SPOTLESS_MM2:
                continue
            good = self.rng.random() < GOOD_SHARE
            label = None if good else list(Failure)[int(self.rng.integers(len(Failure)))]
            sample = self.capture(patch, label)
            if sample is not None:
                yield sample
            if self.rng.random() < 0.2 and self.ink_mm2(patch) >= FOREIGN_MM2:
                yield Blank(False, self.still, self.plane, patch)

    def capture(self, patch: Patch, label: Failure | None) -> Sample | None:
        """Press on the patch and photograph it with that failure; None where this draw did not bring it about."""
        rng = self.rng
        depth_mm, tilt_deg = round(rng.uniform(11.0, 20.0), 1), round(rng.uniform(0.0, 10.0), 1)
        load, flaw, severity = rng.uniform(0.8, 1.0), None, 1.0
        aside_mm = off_mm = np.array(patch.anchor_mm) + np.clip(rng.normal(0.0, 0.2, 2), -0.5, 0.5)
        pressed = True
        if label in LOADS and rng.random() < 0.4:
            load = rng.uniform(*LOADS[label])
        elif label in FLAWS:
            flaw, least = FLAWS[label]
            severity = rng.uniform(least, 1.0)
        match label:
            case Failure.BLANK:
                pressed = rng.random() < 0.5
                load = 0.0
            case Failure.MISPLACED:
                away_mm = rng.uniform(3.0, 10.0) if rng.random() < 0.75 else rng.uniform(10.0, 40.0)
                turn = rng.uniform(0.0, 2.0 * math.pi)
                off_mm = off_mm + away_mm * np.array([math.cos(turn), math.sin(turn)])
                if not self._on_sheet(off_mm):
                    return None
            case Failure.SMEARED:
                away_mm = rng.uniform(15.0, 40.0)
                turn = math.radians(rng.uniform(50.0, 130.0)) * rng.choice([-1.0, 1.0])
                aside_mm = off_mm + away_mm * np.array([math.cos(turn), math.sin(turn)])
                if not self._on_sheet(aside_mm):
                    return None
            case Failure.NEIGHBOUR if rng.random() < 0.5:
                self._overrun(patch)
                self.still = self._render()
            case _:
                pass
        already = self.world.paper.density.copy()
        if label is Failure.SMEARED:
            deep = Waypoint(float(off_mm[0]), float(off_mm[1]), depth_mm)
            away = Waypoint(float(aside_mm[0]), float(aside_mm[1]), depth_mm * rng.uniform(0.3, 1.0))
            path = (dataclasses.replace(deep, depth_mm=0.0), deep, away, deep, dataclasses.replace(deep, depth_mm=0.0))
            mark = self.world.brush.drag(path, tilt_deg, 0.0, ink_load=load, press_seed=self._next_seed())
            self.world.paper.lay(mark, deep.x_mm, deep.y_mm, 0.0)
        elif pressed:
            mark = self._press(depth_mm, tilt_deg, load, flaw, severity)
            self.world.paper.lay(mark, float(off_mm[0]), float(off_mm[1]), 0.0)
        own = self.world.paper.density - already
        if label is Failure.NEIGHBOUR and self._foreign(patch, already) < FOREIGN_MM2 and not self._drip(patch, own):
            label = None
        before, self.still = self.still, self._render()
        sample = Sample(label, self.still, before, self.plane, patch, depth_mm, self.table.sheet_mm)
        return self._photographed(sample, own, already)

    def ink_mm2(self, patch: Patch) -> float:
        """How much of the patch is inked, by the sheet itself."""
        return self._foreign(patch, self.world.paper.density)

    def _photographed(self, sample: Sample, own: NDArray[np.float32], already: NDArray[np.float32]) -> Sample:
        """The same capture with the camera at fault, where the label says so."""
        rng, view = self.rng, self.world.config.view
        match sample.label:
            case Failure.BLURRED:
                sigma_px = rng.uniform(2.2, 6.0)
                image = self._render(dataclasses.replace(view, blur_px=sigma_px))
                return dataclasses.replace(sample, image=image)
            case Failure.GLARE:
                x, y, width, height = self._span_mm(own)
                place = (x + width * rng.random(), y + height * rng.random())
                peak, sigma_mm = rng.uniform(90.0, 260.0), rng.uniform(2.5, 10.0)
                u, v = self._scene.optics.image_of(np.array([place]))[0]
                x, y = np.arange(view.width_px) - u, np.arange(view.height_px)[:, None] - v
                glare = peak * np.exp(-0.5 * (x**2 + y**2) / (sigma_mm * view.px_per_mm) ** 2)
                return dataclasses.replace(sample, image=np.clip(self._render() + glare, 0.0, 255.0).astype(np.uint8))
            case Failure.EXPOSURE:
                sheet = self._scene.optics.homography @ np.array([*np.array(self.table.sheet_mm) / 2, 1.0])
                u, v = (round(float(q)) for q in sheet[:2] / sheet[2])
                paper = float(np.median(self.still[v - 300 : v + 300, u - 400 : u + 400]))
                wanted = rng.uniform(15.0, 60.0) if rng.random() < 0.5 else rng.uniform(290.0, 450.0)
                image = np.clip(sample.image * (wanted / paper), 0.0, 255.0).astype(np.uint8)
                return dataclasses.replace(sample, image=image)
            case Failure.CUT:
                return self._cut(sample, own, already)
            case _:
                return sample

    def _cut(self, sample: Sample, own: NDArray[np.float32], already: NDArray[np.float32]) -> Sample:
        """The camera aimed so that its frame hides between `HIDDEN_MM` and two thirds of the stroke."""
        rng, view = self.rng, self.world.config.view
        left, bottom, width, height = self._span_mm(own)
        half_w, half_h = view.width_px / view.px_per_mm / 2, view.height_px / view.px_per_mm / 2
        x, y = left + width / 2 + rng.uniform(-60.0, 60.0), bottom + height / 2 + rng.uniform(-40.0, 40.0)
        share = rng.uniform(0.2, 0.67)
        side = int(rng.integers(4))
        hidden_mm = max(HIDDEN_MM, share * (width if side < 2 else height))
        if side < 2:
            x = left + hidden_mm + half_w if side == 0 else left + width - hidden_mm - half_w
        else:
            y = bottom + hidden_mm + half_h if side == 2 else bottom + height - hidden_mm - half_h
        aimed = dataclasses.replace(view, centre_mm=(x, y), turn_deg=0.0, keystone=0.0)
        image = self._render(aimed)
        # The plane as it was taken with the camera like this: nothing moved since, the stroke never was in view.
        plane = see_board(image, self._board).plane
        now, self.world.paper.density = self.world.paper.density, already
        before = self._render(aimed)
        self.world.paper.density = now
        self.world.version += 1
        return dataclasses.replace(sample, image=image, before=before, plane=plane)

    def _span_mm(self, own: NDArray[np.float32]) -> tuple[float, float, float, float]:
        """x, y, width, height of the ink of a press, in the paper frame."""
        rows, columns = np.nonzero(own > INK)
        top, left = rows.min() / PX_PER_MM, columns.min() / PX_PER_MM
        width, height = columns.max() / PX_PER_MM - left, rows.max() / PX_PER_MM - top
        return left, self.table.sheet_mm[1] - top - height, width, height

    def _overrun(self, patch: Patch) -> None:
        """A press in a neighbouring patch whose mark reaches into this one."""
        rng = self.rng
        for _ in range(20):
            aside = rng.choice([-1.0, 1.0]) * rng.uniform(10.0, 16.0)
            place = np.array(patch.anchor_mm) + np.array([rng.uniform(-14.0, 4.0), aside])
            if not self._on_sheet(place):
                continue
            before = self.world.paper.density.copy()
            mark = self._press(rng.uniform(11.0, 20.0), rng.uniform(0.0, 10.0), rng.uniform(0.8, 1.0), None, 1.0)
            self.world.paper.lay(mark, float(place[0]), float(place[1]), 0.0)
            if self.ink_mm2(patch) >= FOREIGN_MM2:
                return
            self.world.paper.density = before

    def _drip(self, patch: Patch, own: NDArray[np.float32]) -> bool:
        """A drop of ink in the patch, well away from the stroke, that fell during the press."""
        rng = self.rng
        away = cv2.distanceTransform((own <= INK).astype(np.uint8), cv2.DIST_L2, 5) / PX_PER_MM
        for _ in range(50):
            radius = rng.uniform(1.3, 3.0)
            x = patch.x_mm + rng.uniform(radius, patch.size_x_mm - radius)
            y = patch.y_mm + rng.uniform(radius, patch.size_y_mm - radius)
            at = away[int((self.table.sheet_mm[1] - y) * PX_PER_MM), int(x * PX_PER_MM)]
            if at < radius + DRIP_MM:
                continue
            side = round(2 * (radius + 1) * PX_PER_MM)
            drop = np.zeros((side, side), np.float32)
            cv2.circle(drop, (side // 2, side // 2), round(radius * PX_PER_MM), (float(rng.uniform(0.6, 0.95)),), -1)
            drop = np.asarray(cv2.GaussianBlur(drop, (0, 0), 1.0), np.float32)
            self.world.paper.lay(Footprint(drop, PX_PER_MM, (side / 2, side / 2)), x, y, 0.0)
            return True
        return False

    def _foreign(self, patch: Patch, density: NDArray[np.float32]) -> float:
        top = round((self.table.sheet_mm[1] - patch.y_mm - patch.size_y_mm) * PX_PER_MM)
        left = round(patch.x_mm * PX_PER_MM)
        rows = slice(max(top, 0), top + round(patch.size_y_mm * PX_PER_MM))
        columns = slice(max(left, 0), left + round(patch.size_x_mm * PX_PER_MM))
        return float(np.count_nonzero(density[rows, columns] > INK)) / PX_PER_MM**2

    def _press(self, depth_mm: float, tilt_deg: float, load: float, flaw: Flaw | None, severity: float) -> Footprint:
        seed = self._next_seed()
        return self.world.brush.press(depth_mm, tilt_deg, ink_load=load, press_seed=seed, flaw=flaw, severity=severity)

    def _next_seed(self) -> int:
        self._presses += 1
        return self.world.config.seed * 1009 + self._presses

    def _on_sheet(self, place: NDArray[np.float64]) -> bool:
        width, height = self.table.sheet_mm
        return bool(0.0 <= place[0] <= width and 0.0 <= place[1] <= height)

    def _render(self, view: View | None = None) -> Gray:
        self.world.version += 1
        if view is None:
            return self._scene.render(self._away)
        sound = self.world.config
        self.world.config = dataclasses.replace(sound, view=view)
        try:
            return Scene(self.world).render(self._away)
        finally:
            self.world.config = sound


def draw_rig(rng: np.random.Generator) -> SimConfig:
    """A rig within what a lab may have: brush, light, noise, lens, turn."""
    brush = BrushSpec(
        radius_mm=rng.uniform(5.0, 6.5),
        length_mm=rng.uniform(44.0, 52.0),
        stiffness_n_mm2=rng.uniform(150.0, 260.0),
        friction=rng.uniform(0.15, 0.28),
        set_deg=rng.uniform(6.0, 11.0),
        seed=int(rng.integers(1, 2**31)),
    )
    view = View(
        keystone=rng.uniform(0.0, 0.02),
        turn_deg=rng.uniform(-1.5, 1.5),
        noise=rng.uniform(1.0, 3.0),
        shade=rng.uniform(0.05, 0.3),
        shadow=rng.uniform(0.0, 0.3) if rng.random() < 0.3 else 0.0,
        blur_px=rng.uniform(0.5, 1.0),
    )
    return SimConfig(seed=int(rng.integers(1, 2**20)), brush=brush, view=view, table=Table())


def draw_set(seed: int, captures: int) -> Iterator[Sample | Blank]:
    """At least `captures` captures, sheet after sheet, with the patches before them; equal seeds give equal sets."""
    count, sheet = 0, 0
    while count < captures:
        for sample in Bench(seed, sheet).samples():
            count += isinstance(sample, Sample)
            yield sample
        sheet += 1


@dataclass(slots=True)
class Score:
    """What was, and what it was called."""

    counts: Counter[tuple[Called, Called]] = field(default_factory=Counter[tuple[Called, Called]])
    blanks_seen: Counter[tuple[bool, bool]] = field(default_factory=Counter[tuple[bool, bool]])
    """(blank by the sheet, called blank)."""
    seconds: list[float] = field(default_factory=list[float])

    def of(self, label: Called) -> int:
        """Captures that were this."""
        return sum(self.counts[label, called] for called in LABELS)

    def called(self, label: Called) -> int:
        """Captures that were called this."""
        return sum(self.counts[was, label] for was in LABELS)

    def recall(self, label: Called) -> float:
        """Share of those that were this that were called so. Raises BenchError where there were none."""
        return _share(self.counts[label, label], self.of(label), f"no capture is labelled {_word(label)}")

    def precision(self, label: Called) -> float:
        """Share of those called this that were. Raises BenchError where none was."""
        return _share(self.counts[label, label], self.called(label), f"no capture was called {_word(label)}")

    @property
    def false_alarms(self) -> float:
        """Share of sound captures that were called anything else."""
        return 1.0 - self.recall(None)

    def confused(self, label: Called) -> str:
        """What the others of this were called, in words."""
        wrong = [f"{_word(c)} {self.counts[label, c]}" for c in LABELS if c != label and self.counts[label, c]]
        return ", ".join(wrong) or "nothing else"


def score(samples: Iterable[Sample | Blank], limits: QualityConfig, *, with_previous: bool = True) -> Score:
    """Judge every capture and every blank patch; without `with_previous` the still before a press is withheld."""
    scores = Score()
    for sample in samples:
        if isinstance(sample, Blank):
            seen = Photograph(sample.image, sample.plane, limits).check_blank(sample.patch)
            scores.blanks_seen[sample.blank, seen.passed] += 1
            continue
        began = time.perf_counter()
        before = sample.before if with_previous else None
        photograph = Photograph(sample.image, sample.plane, limits, sample.sheet_mm, before)
        verdict = photograph.check_press(sample.patch, sample.depth_mm)
        scores.seconds.append(time.perf_counter() - began)
        scores.counts[sample.label, Failure(verdict.cause.name) if verdict.cause else None] += 1
    return scores


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Precision and recall of each failure, false alarms, blank patches, and seconds, on at least `n` captures (600).

    The thresholds were chosen on seeds from 101 on. ratio = the figure over its goal; for false alarms and seconds the
    goal over the figure.
    """
    scores = score(draw_set(seed, rounds_of(n, CAPTURES)), QualityConfig())
    captures, results = len(scores.seconds), list[Result]()

    def at_least(name: str, value: float, where: str) -> Result:
        goal = f"goal {GOAL:g}, loopback rig"
        return Result(f"quality.{name}", value, "of 1", goal, value / GOAL, captures, seed, where)

    for failure in Failure:
        where = f"{scores.of(failure)} captures, called {scores.confused(failure)} otherwise"
        results.append(at_least(f"{failure}.recall", scores.recall(failure), where))
        results.append(at_least(f"{failure}.precision", scores.precision(failure), where))
    for blank, name in ((True, "blank patch"), (False, "inked patch")):
        right, wrong = scores.blanks_seen[blank, blank], scores.blanks_seen[blank, not blank]
        results.append(at_least(f"{name}.recall", right / max(right + wrong, 1), f"{right + wrong} patches"))
    where = f"{scores.of(None)} sound captures, called {scores.confused(None)} otherwise"
    results.append(
        at_most("quality.false-alarms", scores.false_alarms, "of 1", FALSE_ALARMS_GOAL, captures, seed, where)
    )
    slow_s = float(np.percentile(scores.seconds, 95))
    results.append(at_most("quality.seconds", slow_s, "s (95 %)", SECONDS_GOAL, captures, seed))
    return results


def _share(part: int, whole: int, otherwise: str) -> float:
    if whole == 0:
        raise BenchError(f"{otherwise}: draw more captures")
    return part / whole


def _word(label: Called) -> str:
    return "sound" if label is None else str(label)
