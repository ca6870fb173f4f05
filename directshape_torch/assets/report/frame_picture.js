// This module draws the left image of a frame with boxes over it.

import { svg } from "report/dom";
import { carName, counted } from "report/format";

const NEAR_M = 0.3;
// These are the edges of a box in the order of `box_corners`, and the line to its front.
export const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

export function framePicture(scene, cars, shown, open) {
  const [width, height] = scene.size_wh;
  const picture = svg("svg", { class: "frame-picture", viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": `Left image with ${counted(cars.length, "car")}` },
    svg("image", { href: scene.image, width, height }));
  if (scene.K === null) return picture;
  if (shown.truth) scene.truth.forEach((box) => picture.append(...boxLines(box, scene.K, "box-truth")));
  scene.cars.forEach((car, place) => {
    if (shown.before && car.box_before) picture.append(...boxLines(car.box_before, scene.K, "box-before"));
    if (shown.after) picture.append(...boxLines(car.box_after, scene.K, "box-after"));
    if (cars[place]) picture.append(...label(car.box_after, scene, cars[place], open));
  });
  return picture;
}

function boxLines(box, K, kind) {
  const corners = Array.from({ length: 8 }, (_, corner) => box.slice(3 * corner, 3 * corner + 3));
  const middle = (ids) => [0, 1, 2].map((axis) => ids.reduce((sum, id) => sum + corners[id][axis], 0) / ids.length);
  const segments = [...EDGES.map(([a, b]) => [corners[a], corners[b]]), [middle([0, 1, 2, 3]), middle([0, 1])]];
  return segments.map((ends) => clipped(...ends)).filter((ends) => ends !== null)
    .map((ends) => svg("polyline", { class: kind, points: ends.map((point) => project(point, K).map((x) => x.toFixed(1)).join(",")).join(" ") }));
}

function clipped(a, b) {
  if (a[2] < NEAR_M && b[2] < NEAR_M) return null;
  const cut = (p, q) => {
    if (p[2] >= NEAR_M) return p;
    const share = (NEAR_M - p[2]) / (q[2] - p[2]);
    return p.map((x, axis) => x + share * (q[axis] - x));
  };
  return [cut(a, b), cut(b, a)];
}

// Pixel centres are whole numbers for K; in SVG the centre of the first pixel is at one half.
function project([x, y, z], K) {
  return [(K[0] * x + K[1] * y + K[2] * z) / z + 0.5, (K[4] * y + K[5] * z) / z + 0.5].map((u) => Math.max(-1e4, Math.min(1e4, u)));
}

function label(box, scene, car, open) {
  const roof = [0, 1, 2].map((axis) => [4, 5, 6, 7].reduce((sum, corner) => sum + box[3 * corner + axis], 0) / 4);
  if (roof[2] < 1) return [];
  const [u, v] = project(roof, scene.K);
  const text = svg("text", { x: u - 4, y: Math.max(v - 6, 15), tabindex: "0", role: "button", "aria-label": `Open car ${carName(car)}`,
    onclick: () => open(car), onkeydown: (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); open(car); } } }, String(car.line));
  return [text];
}
