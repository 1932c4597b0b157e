// A tetrahedral mesh as triangles to draw: its outside, where regions are hidden or cells taken away, and the plane
// through it. Every corner of a triangle lies at a share t between two nodes a and b, so that displacements and
// nodal values of any moment follow without cutting again.

/** What to draw; arrays of one entry per corner: a, b (nodes), t, cell, and inside (1 where a cut shows). */
export function skinOf(mesh, { visible, plane = null, whole = false }) {
  const { regions, owners, neighbours, faces } = mesh;
  const keeps = whole && plane ? keptCells(mesh, plane) : null;
  const shown = (cell) => Boolean(visible[regions[cell]] && (!keeps || keeps[cell]));
  const out = newCorners();
  for (let f = 0; f < owners.length; f++) {
    const first = owners[f], second = neighbours[f];
    const one = shown(first), other = second >= 0 && shown(second);
    if (one === other) continue;
    const cell = one ? first : second;
    const [i, j, k] = one ? [0, 1, 2] : [0, 2, 1];
    const cut = second >= 0 && keeps && keeps[first] !== keeps[second] ? 1 : 0;
    for (const at of [i, j, k]) addCorner(out, faces[3 * f + at], faces[3 * f + at], 0, cell, cut);
  }
  if (plane && !whole) cutCells(mesh, visible, plane, out);
  return finished(out);
}

/** Which side of the plane (normal, offset) each node lies on, in mm; what is positive goes away. */
function heights(mesh, plane) {
  const { points } = mesh, { normal, offset } = plane;
  const found = new Float32Array(points.length / 3);
  for (let i = 0; i < found.length; i++) {
    found[i] = points[3 * i] * normal[0] + points[3 * i + 1] * normal[1] + points[3 * i + 2] * normal[2] - offset;
  }
  return found;
}

function keptCells(mesh, plane) {
  const height = heights(mesh, plane), { cells } = mesh;
  const keeps = new Uint8Array(cells.length / 4);
  for (let c = 0; c < keeps.length; c++) {
    keeps[c] = height[cells[4 * c]] + height[cells[4 * c + 1]] + height[cells[4 * c + 2]] + height[cells[4 * c + 3]] <= 0 ? 1 : 0;
  }
  return keeps;
}

/** The polygon in which the plane meets each cell: one triangle, or two. */
function cutCells(mesh, visible, plane, out) {
  const height = heights(mesh, plane), { cells, regions } = mesh;
  for (let c = 0; c < regions.length; c++) {
    if (!visible[regions[c]]) continue;
    const above = [], below = [];
    for (let k = 0; k < 4; k++) {
      const node = cells[4 * c + k];
      (height[node] > 0 ? above : below).push(node);
    }
    if (!above.length || !below.length) continue;
    const at = (a, b) => [a, b, height[a] / (height[a] - height[b])];
    let ring;
    if (above.length === 1) ring = below.map((b) => at(above[0], b));
    else if (below.length === 1) ring = above.map((a) => at(a, below[0]));
    else ring = [at(above[0], below[0]), at(above[0], below[1]), at(above[1], below[1]), at(above[1], below[0])];
    for (let k = 1; k + 1 < ring.length; k++) {
      for (const [a, b, t] of [ring[0], ring[k], ring[k + 1]]) addCorner(out, a, b, t, c, 1);
    }
  }
}

const newCorners = () => ({ a: [], b: [], t: [], cell: [], inside: [] });

function addCorner(out, a, b, t, cell, inside) {
  out.a.push(a); out.b.push(b); out.t.push(t); out.cell.push(cell); out.inside.push(inside);
}

const finished = (out) => ({
  a: Uint32Array.from(out.a), b: Uint32Array.from(out.b), t: Float32Array.from(out.t),
  cell: Uint32Array.from(out.cell), inside: Float32Array.from(out.inside), count: out.a.length,
});

/** Vectors of the nodes at the corners; zero without vectors. */
export function vectorsAt(corners, vectors) {
  const found = new Float32Array(3 * corners.count);
  if (!vectors) return found;
  for (let i = 0; i < corners.count; i++) {
    const a = 3 * corners.a[i], b = 3 * corners.b[i], t = corners.t[i];
    for (let k = 0; k < 3; k++) found[3 * i + k] = vectors[a + k] + t * (vectors[b + k] - vectors[a + k]);
  }
  return found;
}

/** Values of cells or of nodes (a table per region, see nodalMeans) at the corners. */
export function valuesAt(corners, mesh, field) {
  const found = new Float32Array(corners.count);
  if (field.on === "cells") {
    for (let i = 0; i < corners.count; i++) found[i] = field.values[corners.cell[i]];
    return found;
  }
  const count = mesh.points.length / 3;
  for (let i = 0; i < corners.count; i++) {
    const base = field.byRegion ? mesh.regions[corners.cell[i]] * count : 0;
    const a = field.values[base + corners.a[i]], b = field.values[base + corners.b[i]];
    found[i] = a + corners.t[i] * (b - a);
  }
  return found;
}

/** Means of the cells around each node, apart for each region so that a jump between tissues stays one. */
export function nodalMeans(mesh, values) {
  const count = mesh.points.length / 3, { cells, regions } = mesh;
  const kinds = 1 + regions.reduce((a, b) => Math.max(a, b), 0);
  const sums = new Float32Array(kinds * count), times = new Float32Array(kinds * count);
  for (let c = 0; c < regions.length; c++) {
    for (let k = 0; k < 4; k++) {
      const at = regions[c] * count + cells[4 * c + k];
      sums[at] += values[c];
      times[at] += 1;
    }
  }
  for (let i = 0; i < sums.length; i++) sums[i] = times[i] ? sums[i] / times[i] : 0;
  return { on: "nodes", byRegion: true, values: sums };
}
