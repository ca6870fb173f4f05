// This module reads the data in the page. Details of a frame are parsed on first use.

import { byId } from "report/dom";

const parsed = new Map();

function read(name) {
  if (!parsed.has(name)) {
    const block = byId(`data-${name}`);
    parsed.set(name, block === null ? null : JSON.parse(block.textContent));
  }
  return parsed.get(name);
}

export const run = read("run");
export const frames = read("frames");

const table = read("cars");
const countInFrame = new Map();

// Each car is an object; `place` is its index in the details of its frame.
export const cars = table.rows.map((values, index) => {
  const car = Object.fromEntries(table.columns.map((name, column) => [name, values[column]]));
  const place = countInFrame.get(car.frame) ?? 0;
  countInFrame.set(car.frame, place + 1);
  return { ...car, index, place, frameId: frames.ids[car.frame] };
});

export const hasLabels = cars.some((car) => car.iou_after !== null);
export const tracks = [...new Set(cars.map((car) => car.track).filter(Boolean))];
export const hasErrorsBefore = cars.some((car) => car.iou_before !== null);

export const carsOfFrame = (frame) => cars.filter((car) => car.frame === frame);
// Returns the positions of a car in all frames of its track, in camera coordinates.
export const pathOf = (car) => cars.filter((other) => car.track && other.track === car.track).map((view) => [view.x_m, view.y_m, view.distance_m]);
export const thumbnailsOf = (car) => read(`thumbnails-${car.frame}`)?.[car.place] ?? {};
export const mapsOf = (car) => read(`maps-${car.frame}`)?.[car.place] ?? null;
export const sceneOf = (frame) => read(`scene-${frame}`);
export const meanMesh = () => read("mean-mesh");
