"""Layers over a surface as columns of nodes, filled with tetrahedra that conform whatever the columns' steps.

Vocabulary
----------
column   the nodes above one base node: at each layer's outer face, and between where the layer is thick.
step     from one node of a column to the next.
height   of a node above the base, counted in layers: 1.5 is halfway through the second layer from below.

Between three neighbouring columns the front rises one step at a time and leaves a tetrahedron behind each.
Which column is next follows from one order of all nodes, so two prisms that share a side split it alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array

Ints = NDArray[np.int64]

TALLEST = 1.3  # step over edge length


@dataclass(frozen=True)
class Columns:
    """Nodes over base nodes.

    Attributes
    ----------
    base : (b,) numbers of the base nodes.
    top : (b,) numbers of the columns' outermost nodes.
    owner : (k,) index into ``base`` of each new node; the outermost ones come first, in order of ``base``.
    height : (k,) of the new nodes.
    steps : (layers, b) of each layer in each column.
    """

    base: Ints
    top: Ints
    owner: Ints
    height: Array
    steps: Ints

    def placed(self, low: Array, high: Array, floors: Array) -> Array:
        """Points (k, 3) of the new nodes on the lines from ``low`` to ``high`` (b, 3).

        ``floors`` (layers + 1, b) are the distances of the layers' faces from the base, zero first, as
        shares of the column.
        """
        layer = np.minimum(self.height.astype(np.int64), len(self.steps) - 1)
        below, above = floors[layer, self.owner], floors[layer + 1, self.owner]
        share = below + (self.height - layer) * (above - below)
        return low[self.owner] + share[:, None] * (high - low)[self.owner]

    def tets(self, triangles: Ints) -> tuple[Ints, Ints]:
        """Tetrahedra (m, 4) over outward triangles (t, 3) of base nodes, and the layer (m,) of each."""
        nodes, height = self._stacked()
        column = np.searchsorted(self.base, triangles)
        total = self.steps.sum(axis=0)[column]
        at = np.zeros_like(column)
        done, layers = [], []
        while True:
            last = at == total
            going = ~last.all(axis=1)
            if not going.any():
                break
            column, total, at, last = column[going], total[going], at[going], last[going]
            following = np.where(last, at, at + 1)
            rank = np.where(last, np.inf, height[column, following])
            # Of nodes as high as each other the one over the greatest base node comes first.
            lowest = rank == rank.min(axis=1, keepdims=True)
            side = np.where(lowest, column, -1).argmax(axis=1)
            row = np.arange(len(column))
            fresh = nodes[column[row, side], following[row, side]]
            done.append(np.column_stack([nodes[column, at], fresh]))
            layers.append(np.ceil(rank[row, side]).astype(np.int64) - 1)
            at[row, side] += 1
        return np.concatenate(done), np.concatenate(layers)

    def _stacked(self) -> tuple[Ints, Array]:
        """Node numbers and heights (b, most steps + 1) of each column from its base up."""
        total = self.steps.sum(axis=0)
        nodes = np.full((len(self.base), total.max() + 1), -1, dtype=np.int64)
        height = np.full(nodes.shape, np.inf)
        nodes[:, 0], height[:, 0] = self.base, 0.0
        order = np.lexsort([self.height, self.owner])
        owner = self.owner[order]
        place = np.arange(len(order)) - np.searchsorted(owner, owner) + 1
        nodes[owner, place] = self.top[0] + order
        height[owner, place] = self.height[order]
        return nodes, height


def build_columns(base: Ints, steps: Ints, first: int) -> Columns:
    """Columns of ``steps`` (layers, b) over sorted base nodes (b,); new nodes are numbered from ``first``."""
    count, layers = len(base), len(steps)
    owner, height = [np.arange(count)], [np.full(count, float(layers))]
    for layer, number in enumerate(steps):
        for step in range(1, int(number.max()) + 1):
            chosen = number >= step
            if layer == layers - 1:
                chosen &= number > step
            owner.append(np.flatnonzero(chosen))
            height.append(layer + step / number[chosen])
    return Columns(
        base, first + np.arange(count), np.concatenate(owner), np.concatenate(height), steps.astype(np.int64)
    )


def choose_even_steps(thickness: Array, edge: Array, edges: Ints, most: int) -> Ints:
    """Steps (b,) with which a layer (b,) mm thick has no elements much taller than their edges (b,) are long.

    Neighbours along ``edges`` (e, 2) differ by one at most.
    """
    steps = np.clip(np.ceil(thickness / (TALLEST * edge)), 1, most).astype(np.int64)
    for _ in range(most):
        allowed = np.full(len(steps), most, dtype=np.int64)
        np.minimum.at(allowed, edges[:, 0], steps[edges[:, 1]] + 1)
        np.minimum.at(allowed, edges[:, 1], steps[edges[:, 0]] + 1)
        steps = np.minimum(steps, allowed)
    return steps
