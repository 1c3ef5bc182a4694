"""Layout of a board: a router for two layers, and what hands its tracks to KiCad.

`Router` is plain Python. The rest needs KiCad's module ``pcbnew``, which belongs to the system's
Python: `hardware.kicad` runs this file there, with the board as JSON on standard input.
"""

from __future__ import annotations

import heapq
import importlib
import json
import math
import sys
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

Point = tuple[float, float]
Node = tuple[int, int, int]
"""Layer (0 is the front), column, row of the grid."""

VIA: Final = (0.8, 0.4)
"""Diameter and hole of a via, mm."""

EDGE: Final = 0.5
"""From the outline to copper, mm."""

SCREW: Final = 2.8
"""Radius around a screw's hole in which there are no tracks, mm: head or washer."""


class Pad(NamedTuple):
    """A pad as the router sees it: a box with its corners rounded; mm.

    Parameters
    ----------
    name : str
        U1.21.
    net : str
        Empty if it is on none.
    at : tuple of float
    half : tuple of float
        Half width and height.
    corner : float
        Their radius.
    layers : tuple of int
    """

    name: str
    net: str
    at: Point
    half: Point
    corner: float
    layers: tuple[int, ...]

    def distance(self, x: float, y: float) -> float:
        """Return the distance from its edge; inside, 0 or less."""
        across = abs(x - self.at[0]) - self.half[0] + self.corner
        along = abs(y - self.at[1]) - self.half[1] + self.corner
        outside = math.hypot(max(across, 0.0), max(along, 0.0))
        return outside + min(max(across, along), 0.0) - self.corner


class Track(NamedTuple):
    """A straight piece of a net on a layer; a via has the layer -1 and no length."""

    net: str
    layer: int
    start: Point
    end: Point
    width: float


class UnroutableError(RuntimeError):
    """No way was found for a net."""


@dataclass
class Router:
    """Finds tracks for every net, nets that are in each other's way in turn.

    Each net is a shortest path from pin to pin on a grid, on which other nets' tracks may be
    crossed at a price; what was crossed is taken up and laid again, and crossing there becomes
    dearer.

    Parameters
    ----------
    pads : list of Pad
    size : tuple of float
        Of the board, mm.
    corner : tuple of float
        Its lower left corner, mm.
    holes : list of tuple of float
        Middles of screw holes.
    grid, clearance : float
        mm.
    widths : mapping of str to float
        Of each net to be routed, mm.
    """

    pads: list[Pad]
    size: Point
    corner: Point
    holes: list[Point]
    grid: float
    clearance: float
    widths: Mapping[str, float]
    _fixed: dict[Node, dict[str, float]] = field(default_factory=dict)
    _laid: dict[Node, dict[str, float]] = field(default_factory=dict)
    _dear: dict[Node, float] = field(default_factory=dict)
    _paths: dict[str, list[list[Node]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.reach = max([*self.widths.values(), VIA[0]]) / 2 + self.clearance
        left, low = self.corner
        margin = EDGE / self.grid
        self.columns = range(
            math.ceil(left / self.grid + margin),
            math.floor((left + self.size[0]) / self.grid - margin) + 1,
        )
        self.rows = range(
            math.ceil(low / self.grid + margin),
            math.floor((low + self.size[1]) / self.grid - margin) + 1,
        )
        for pad in self.pads:
            for layer in pad.layers:
                self._keep_off(pad, layer)
        for x, y in self.holes:
            radius = SCREW - self.clearance
            hole = Pad("", "(hole)", (x, y), (radius, radius), radius, (0, 1))
            for layer in (0, 1):
                self._keep_off(hole, layer)

    def _keep_off(self, pad: Pad, layer: int) -> None:
        spans = [
            range(
                math.ceil((middle - half - self.reach) / self.grid),
                math.floor((middle + half + self.reach) / self.grid) + 1,
            )
            for middle, half in zip(pad.at, pad.half, strict=True)
        ]
        net = pad.net or f"({pad.name})"
        for i in spans[0]:
            for j in spans[1]:
                distance = pad.distance(i * self.grid, j * self.grid)
                if distance < self.reach:
                    near = self._fixed.setdefault((layer, i, j), {})
                    near[net] = min(distance, near.get(net, math.inf))

    def _to_edge(self, node: Node) -> float:
        """Return the distance of a node from the outline, less what copper keeps from it anyway."""
        x, y = node[1] * self.grid - self.corner[0], node[2] * self.grid - self.corner[1]
        return min(x, y, self.size[0] - x, self.size[1] - y) - EDGE

    def _free(self, node: Node, net: str, half: float) -> bool:
        if node[1] not in self.columns or node[2] not in self.rows or self._to_edge(node) < half:
            return False
        near = self._fixed.get(node)
        least = half + self.clearance - 1e-9
        return near is None or all(d >= least or other == net for other, d in near.items())

    def _crossed(self, node: Node, net: str, half: float) -> list[str]:
        near = self._laid.get(node)
        if near is None:
            return []
        least = half + self.clearance - 1e-9
        return [other for other, d in near.items() if d < least and other != net]

    def _access(self, pad: Pad) -> list[Node]:
        """Return the nodes at which a track reaches a pad: those nearest to its middle."""
        i, j = round(pad.at[0] / self.grid), round(pad.at[1] / self.grid)
        return [(layer, i, j) for layer in pad.layers]

    def _steps(self, node: Node) -> Iterator[tuple[Node, float]]:
        layer, i, j = node
        # the front's tracks rather go across, the back's up and down
        across, along = (1.0, 1.25) if layer == 0 else (1.25, 1.0)
        yield (layer, i + 1, j), across
        yield (layer, i - 1, j), across
        yield (layer, i, j + 1), along
        yield (layer, i, j - 1), along
        for di in (1, -1):
            for dj in (1, -1):
                yield (layer, i + di, j + dj), 1.55

    def _find(self, net: str, start: Iterable[Node], goals: set[Node]) -> list[Node]:
        half = self.widths[net] / 2
        price = 6.0 / self.grid
        aims = [(i, j) for _, i, j in goals]

        def rest(node: Node) -> float:
            return min(max(abs(node[1] - i), abs(node[2] - j)) for i, j in aims)

        best: dict[Node, float] = dict.fromkeys(start, 0.0)
        before: dict[Node, Node] = {}
        queue = [(rest(node), node) for node in best]
        heapq.heapify(queue)
        done = set()
        penalties: dict[Node, float] = {}

        def penalty(node: Node) -> float:
            if node not in penalties:
                if not self._free(node, net, half):
                    penalties[node] = math.inf
                else:
                    crossed = len(self._crossed(node, net, half))
                    penalties[node] = crossed * price * (1.0 + self._dear.get(node, 0.0))
            return penalties[node]

        while queue:
            _, node = heapq.heappop(queue)
            if node in done:
                continue
            done.add(node)
            if node in goals:
                path = [node]
                while path[-1] in before:
                    path.append(before[path[-1]])
                return path[::-1]
            last = before.get(node)
            for step, length in self._steps(node):
                cost = length + penalty(step)
                if step[1] != node[1] and step[2] != node[2]:
                    cost += penalty((node[0], step[1], node[2]))
                    cost += penalty((node[0], node[1], step[2]))
                if last and (step[1] - node[1], step[2] - node[2]) != (
                    node[1] - last[1],
                    node[2] - last[2],
                ):
                    cost += 0.3
                if cost == math.inf:
                    continue
                if best[node] + cost < best.get(step, math.inf):
                    best[step] = best[node] + cost
                    before[step] = node
                    heapq.heappush(queue, (best[step] + rest(step), step))
            other = (1 - node[0], node[1], node[2])
            if best[node] + 4.0 / self.grid < best.get(other, math.inf) and self._via(node, net):
                radius = VIA[0] / 2
                crossed = sum(len(self._crossed(end, net, radius)) for end in (node, other))
                cost = 4.0 / self.grid + crossed * price * (1.0 + self._dear.get(node, 0.0))
                if best[node] + cost < best.get(other, math.inf):
                    best[other] = best[node] + cost
                    before[other] = node
                    heapq.heappush(queue, (best[other] + rest(other), other))
        raise UnroutableError(net)

    def _via(self, node: Node, net: str) -> bool:
        """Whether a via may be at a node; not in or next to a pad, whose hole it would meet."""
        _, i, j = node
        return all(
            self._free((layer, i, j), net, VIA[0] / 2)
            and self._fixed.get((layer, i, j), {}).get(net, math.inf) > VIA[0] / 2
            for layer in (0, 1)
        )

    def _discs(self, net: str) -> Iterator[tuple[Node, float]]:
        """Yield where a net's copper is: nodes and half widths."""
        half = self.widths[net] / 2
        for path in self._paths[net]:
            for a, b in zip(path, [*path[1:], path[-1]], strict=True):
                yield a, half
                if a[0] != b[0]:
                    yield a, VIA[0] / 2
                    yield b, VIA[0] / 2

    def _lay(self, net: str) -> None:
        for (layer, i, j), half in self._discs(net):
            far = math.ceil((half + self.reach) / self.grid)
            for di in range(-far, far + 1):
                for dj in range(-far, far + 1):
                    distance = math.hypot(di, dj) * self.grid - half
                    if distance < self.reach:
                        near = self._laid.setdefault((layer, i + di, j + dj), {})
                        near[net] = min(distance, near.get(net, math.inf))

    def _take_up(self, net: str) -> None:
        del self._paths[net]
        for near in self._laid.values():
            near.pop(net, None)

    def _route(self, net: str) -> set[str]:
        """Lay a net; return the nets that it crosses."""
        pads = [pad for pad in self.pads if pad.net == net]
        middle = [sum(pad.at[i] for pad in pads) / len(pads) for i in (0, 1)]
        pads.sort(key=lambda pad: (math.dist(pad.at, middle), pad.name))
        tree = set(self._access(pads[0]))
        waiting = {node: pad for pad in pads[1:] for node in self._access(pad)}
        self._paths[net] = []
        while waiting:
            path = self._find(net, sorted(tree), set(waiting))
            reached = waiting[path[-1]]
            tree.update(path, self._access(reached))
            waiting = {node: pad for node, pad in waiting.items() if pad != reached}
            self._paths[net].append(path)
        crossed: set[str] = set()
        for node, half in self._discs(net):
            others = self._crossed(node, net, half)
            if others:
                self._dear[node] = self._dear.get(node, 0.0) + 0.5
                crossed.update(others)
        self._lay(net)
        return crossed

    def run(self, most: int = 400) -> list[Track]:
        """Route every net that has two pads or more.

        Parameters
        ----------
        most : int, optional
            Times that a net is laid, all together.

        Raises
        ------
        UnroutableError
            A net has no way, or nets were still in each other's way at the end.
        """
        counts = {net: sum(pad.net == net for pad in self.pads) for net in self.widths}
        queue = sorted((net for net in counts if counts[net] > 1), key=self._extent)
        for _ in range(most):
            if not queue:
                return [track for net in sorted(self._paths) for track in self._tracks(net)]
            net = queue.pop(0)
            for crossed in sorted(self._route(net)):
                self._take_up(crossed)
                queue.append(crossed)
        raise UnroutableError(", ".join(queue))

    def _extent(self, net: str) -> tuple[float, str]:
        """Short nets first."""
        ends = [pad.at for pad in self.pads if pad.net == net]
        return sum(max(c) - min(c) for c in zip(*ends, strict=True)), net

    def _tracks(self, net: str) -> Iterator[Track]:
        width = self.widths[net]
        for pad in self.pads:
            if pad.net == net:
                layer, i, j = self._access(pad)[-1]
                end = (i * self.grid, j * self.grid)
                if math.dist(end, pad.at) > 1e-6:
                    yield Track(net, layer, pad.at, end, min(width, 2 * min(pad.half)))
        for path in self._paths[net]:
            start = path[0]
            for n, (a, b) in enumerate(pairwise(path), start=1):
                if a[0] != b[0]:
                    at = (a[1] * self.grid, a[2] * self.grid)
                    yield Track(net, -1, at, at, VIA[0])
                    start = b
                    continue
                after = path[n + 1] if n + 1 < len(path) else None
                if after is None or [q - p for p, q in zip(a, b, strict=True)] != [
                    q - p for p, q in zip(b, after, strict=True)
                ]:
                    ends = [(node[1] * self.grid, node[2] * self.grid) for node in (start, b)]
                    yield Track(net, a[0], ends[0], ends[1], width)
                    start = b


# --- KiCad --------------------------------------------------------------------------------------


class _Canvas:
    """A board of pcbnew, in the frame of the job: mm, y up, seen from the front."""

    def __init__(self, job: Mapping[str, Any]) -> None:
        pcbnew: Any = importlib.import_module("pcbnew")
        self.k = pcbnew
        pcbnew.KIID.SeedGenerator(job["seed"])
        self.job = job
        self.board = pcbnew.CreateEmptyBoard()
        self.board.SetCopperLayerCount(2)
        settings = self.board.GetDesignSettings()
        settings.SetBoardThickness(pcbnew.FromMM(job["thickness"]))
        settings.SetAuxOrigin(self.vector((0.0, 0.0)))
        settings.SetGridOrigin(self.vector((0.0, 0.0)))
        block = self.board.GetTitleBlock()
        block.SetTitle(job["title"])
        self.sides = (pcbnew.F_Cu, pcbnew.B_Cu)
        self.silk = (pcbnew.F_SilkS, pcbnew.B_SilkS)
        self.nets: dict[str, Any] = {}
        self.taken: list[tuple[int, float, float, float, float]] = []

    def vector(self, at: Point) -> Any:
        x, y = self.job["origin"]
        return self.k.VECTOR2I(self.k.FromMM(x + at[0]), self.k.FromMM(y - at[1]))

    def point(self, vector: Any) -> Point:
        x, y = self.job["origin"]
        return (
            round(self.k.ToMM(vector.x) - x, 6),
            round(y - self.k.ToMM(vector.y), 6),
        )

    def net(self, name: str) -> Any:
        if name not in self.nets:
            self.nets[name] = self.k.NETINFO_ITEM(self.board, name)
            self.board.Add(self.nets[name])
        return self.nets[name]

    def outline(self) -> None:
        """Draw the board's edge and its screw holes."""
        left, low = self.job["corner"]
        width, height = self.job["size"]
        box = self.k.PCB_SHAPE(self.board, self.k.SHAPE_T_RECT)
        box.SetStart(self.vector((left, low + height)))
        box.SetEnd(self.vector((left + width, low)))
        box.SetLayer(self.k.Edge_Cuts)
        box.SetWidth(self.k.FromMM(0.1))
        self.board.Add(box)
        for n, at in enumerate(self.job["holes"], start=1):
            hole = self.load(*self.job["hole_footprint"])
            hole.SetReference(f"H{n}")
            hole.SetPosition(self.vector(at))
            hole.SetAttributes(
                self.k.FP_BOARD_ONLY | self.k.FP_EXCLUDE_FROM_BOM | self.k.FP_EXCLUDE_FROM_POS_FILES
            )
            hole.Reference().SetVisible(False)
            hole.Value().SetVisible(False)
            self.board.Add(hole)

    def load(self, library: str, name: str) -> Any:
        footprint = self.k.FootprintLoad(f"{self.job['footprints']}/{library}.pretty", name)
        if footprint is None:
            raise FileNotFoundError(f"{library}:{name}")
        footprint.SetFPID(self.k.LIB_ID(library, name))
        return footprint

    def place(self, part: Mapping[str, Any]) -> None:
        """Put a part with pin 1 where it belongs, and pin 2 on the side where it belongs."""
        footprint = self.load(*part["footprint"].split(":"))
        footprint.SetReference(part["reference"])
        footprint.SetValue(part["value"])
        footprint.SetPath(self.k.KIID_PATH(part["path"]))
        self.board.Add(footprint)
        pads: dict[str, Any] = {}
        for pad in footprint.Pads():
            pads.setdefault(pad.GetNumber(), pad)
            net = part["nets"].get(pad.GetNumber())
            if net:
                pad.SetNet(self.net(net))
        if set(pads) - {""} != set(part["pins"]):
            raise ValueError(f"{part['reference']}: {part['footprint']} has other pads")
        if part["back"]:
            footprint.Flip(footprint.GetPosition(), self.k.FLIP_DIRECTION_LEFT_RIGHT)
        first, second = (self.point(pads[number].GetPosition()) for number in ("1", "2"))
        now = math.degrees(math.atan2(second[1] - first[1], second[0] - first[0]))
        wanted = {"right": 0, "up": 90, "left": 180, "down": 270}[part["toward"]]
        turned = footprint.GetOrientationDegrees() + wanted - now
        footprint.SetOrientationDegrees(round(turned) % 360)
        footprint.Move(self.vector(part["at"]) - pads["1"].GetPosition())
        if not part["fitted"]:
            footprint.SetDNP(True)
        footprint.Value().SetVisible(False)

    def pads(self) -> list[Pad]:
        """Return every pad as the router wants it."""
        k = self.k
        found = []
        for footprint in self.board.GetFootprints():
            for pad in footprint.Pads():
                box = pad.GetBoundingBox()
                half = (k.ToMM(box.GetWidth()) / 2, k.ToMM(box.GetHeight()) / 2)
                layers = tuple(n for n, side in enumerate(self.sides) if pad.IsOnLayer(side))
                if not layers or pad.GetAttribute() == k.PAD_ATTRIB_NPTH:
                    continue
                round_ = pad.GetShape() in {k.PAD_SHAPE_CIRCLE, k.PAD_SHAPE_OVAL}
                name = f"{footprint.GetReference()}.{pad.GetNumber()}"
                at = self.point(pad.GetPosition())
                corner = min(half) if round_ else 0.0
                found.append(Pad(name, pad.GetNetname(), at, half, corner, layers))
        return sorted(found)

    def tracks(self, tracks: Iterable[Track]) -> None:
        """Draw tracks and vias."""
        for track in tracks:
            if track.layer < 0:
                item = self.k.PCB_VIA(self.board)
                item.SetPosition(self.vector(track.start))
                item.SetWidth(self.k.FromMM(VIA[0]))
                item.SetDrill(self.k.FromMM(VIA[1]))
            else:
                item = self.k.PCB_TRACK(self.board)
                item.SetStart(self.vector(track.start))
                item.SetEnd(self.vector(track.end))
                item.SetWidth(self.k.FromMM(track.width))
                item.SetLayer(self.sides[track.layer])
            item.SetNet(self.net(track.net))
            self.board.Add(item)

    def zones(self) -> None:
        """Cover both layers with the nets that have them; filled when the board is saved."""
        left, low = self.job["corner"]
        width, height = self.job["size"]
        corners = [
            (left + EDGE, low + EDGE),
            (left + width - EDGE, low + EDGE),
            (left + width - EDGE, low + height - EDGE),
            (left + EDGE, low + height - EDGE),
        ]
        for layer, name in zip(self.sides, self.job["zones"], strict=True):
            zone = self.k.ZONE(self.board)
            zone.SetLayer(layer)
            zone.SetNet(self.net(name))
            zone.SetLocalClearance(self.k.FromMM(0.25))
            zone.SetMinThickness(self.k.FromMM(0.25))
            zone.SetThermalReliefGap(self.k.FromMM(0.3))
            zone.SetThermalReliefSpokeWidth(self.k.FromMM(self.job["spoke"]))
            zone.SetIslandRemovalMode(self.k.ISLAND_REMOVAL_MODE_ALWAYS)
            zone.AddPolygon(self.k.VECTOR_VECTOR2I([self.vector(at) for at in corners]))
            self.board.Add(zone)

    # text: nothing printed lies on a pad, another print or the edge

    def _box(self, item: Any) -> tuple[float, float, float, float]:
        box = item.GetBoundingBox()
        x0, y0 = self.point(self.k.VECTOR2I(box.GetLeft(), box.GetBottom()))
        x1, y1 = self.point(self.k.VECTOR2I(box.GetRight(), box.GetTop()))
        return x0, y0, x1, y1

    def _take(self, side: int, box: tuple[float, float, float, float], gap: float) -> None:
        x0, y0, x1, y1 = box
        self.taken.append((side, x0 - gap, y0 - gap, x1 + gap, y1 + gap))

    def _vacant(self, side: int, box: tuple[float, float, float, float]) -> bool:
        left, low = self.job["corner"]
        width, height = self.job["size"]
        x0, y0, x1, y1 = box
        inside = x0 > left + 0.4 and y0 > low + 0.4
        inside = inside and x1 < left + width - 0.4 and y1 < low + height - 0.4
        return inside and not any(
            side == s and x0 < b[2] and x1 > b[0] and y0 < b[3] and y1 > b[1]
            for s, *b in self.taken
        )

    def occupy(self) -> None:
        """Note where pads, holes and the parts' own prints are."""
        for footprint in self.board.GetFootprints():
            for pad in footprint.Pads():
                for side, layer in enumerate(self.sides):
                    if pad.IsOnLayer(layer) or pad.GetAttribute() == self.k.PAD_ATTRIB_NPTH:
                        gap = 1.3 if pad.GetAttribute() == self.k.PAD_ATTRIB_NPTH else 0.2
                        self._take(side, self._box(pad), gap)
            for item in footprint.GraphicalItems():
                for side, layer in enumerate(self.silk):
                    if item.GetLayer() == layer:
                        self._take(side, self._box(item), 0.05)

    def write(
        self, text: str, at: Point, side: int, *, size: float = 0.9, degrees: float = 0.0
    ) -> None:
        """Print a text, whether or not there is room."""
        item = self.k.PCB_TEXT(self.board)
        item.SetText(text)
        item.SetLayer(self.silk[side])
        self._style(item, side, size, degrees)
        item.SetPosition(self.vector(at))
        self.board.Add(item)
        self._take(side, self._box(item), 0.1)

    def _style(self, item: Any, side: int, size: float, degrees: float) -> None:
        item.SetTextSize(self.k.VECTOR2I(self.k.FromMM(size), self.k.FromMM(size)))
        item.SetTextThickness(self.k.FromMM(0.15))
        item.SetMirrored(side == 1)
        item.SetTextAngleDegrees(degrees)
        item.SetHorizJustify(self.k.GR_TEXT_H_ALIGN_CENTER)
        item.SetVertJustify(self.k.GR_TEXT_V_ALIGN_CENTER)

    def references(self) -> None:
        """Print every part's name near it, nearer than to any other, or else on it."""
        named = [part for part in self.board.GetFootprints() if part.Reference().IsVisible()]
        bodies = {}
        for part in sorted(named, key=lambda part: part.GetReference()):
            box = part.GetBoundingBox(False)
            x0, y0 = self.point(self.k.VECTOR2I(box.GetLeft(), box.GetBottom()))
            x1, y1 = self.point(self.k.VECTOR2I(box.GetRight(), box.GetTop()))
            middle, half = ((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2, (y1 - y0) / 2)
            bodies[part.GetReference()] = Pad("", "", middle, half, 0.0, (int(part.IsFlipped()),))
        for part in sorted(named, key=lambda part: part.GetReference()):
            self._name(part.Reference(), bodies[part.GetReference()], list(bodies.values()))

    def _name(self, text: Any, own: Pad, bodies: list[Pad]) -> None:
        (side,) = own.layers
        others = [body for body in bodies if body is not own and body.layers == own.layers]
        steps = [range(-int(2 * half) - 5, int(2 * half) + 6) for half in own.half]
        spots = []
        for at in ((own.at[0] + i / 2, own.at[1] + j / 2) for i in steps[0] for j in steps[1]):
            gap = max(own.distance(*at), 0.0)
            if gap > 3.0:
                continue
            crowd = max(0.0, 1.6 - min((body.distance(*at) for body in others), default=9.0))
            cost = abs(gap - 0.7) + crowd + 0.02 * math.dist(at, own.at)
            spots += [(cost, 0, at), (cost + 0.2, 90, at)]
        for _, degrees, at in sorted(spots):
            self._style(text, side, 0.9, degrees)
            text.SetPosition(self.vector(at))
            if self._vacant(side, self._box(text)):
                break
        else:
            raise UnroutableError(f"no room for the name {text.GetText()}")
        text.SetKeepUpright(True)
        text.SetLayer(self.silk[side])
        self._take(side, self._box(text), 0.1)


def lay_out(job: Mapping[str, Any]) -> None:
    """Place, route, fill and save; `hardware.kicad` says what a job holds."""
    canvas = _Canvas(job)
    for name in job["nets"]:
        canvas.net(name)
    canvas.outline()
    for part in job["parts"]:
        canvas.place(part)
    pads = canvas.pads()
    router = Router(
        pads,
        tuple(job["size"]),
        tuple(job["corner"]),
        [tuple(at) for at in job["holes"]],
        job["grid"],
        job["clearance"],
        job["widths"],
    )
    canvas.tracks(router.run())
    canvas.zones()
    canvas.occupy()
    for text in job["texts"]:
        canvas.write(**text)
    canvas.references()
    canvas.k.SaveBoard(job["output"], canvas.board, True)
    board = canvas.k.LoadBoard(job["output"])  # with its project's rules, which filling asks
    canvas.k.ZONE_FILLER(board).Fill(board.Zones())
    canvas.k.SaveBoard(job["output"], board, True)


if __name__ == "__main__":
    lay_out(json.load(sys.stdin))
