// Numbers and names as the page shows them.

export const MISSING = "–";

export function number(value, decimals = 2) {
  return value === null || value === undefined ? MISSING : value.toFixed(decimals);
}

export function percent(value, decimals = 0) {
  return value === null || value === undefined ? MISSING : `${(100 * value).toFixed(decimals)} %`;
}

export function change(before, after, decimals = 2) {
  return before === null || before === undefined ? number(after, decimals) : `${number(before, decimals)} → ${number(after, decimals)}`;
}

export const carName = (car) => `${car.frameId}, line ${car.line}`;

export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

// Relative change of the cost, or null.
export function costChange(car) {
  return car.cost_before > 0 && car.cost_after !== null ? car.cost_after / car.cost_before - 1 : null;
}

// How much better a car became: by its label where the run has any, else by its probability. `car_gains` of
// chosen_frames.py is the same rule.
export function gain(car, byLabels) {
  if (!car.refined) return null;
  if (!byLabels) return car.probability_better;
  return car.iou_before === null || car.iou_after === null ? null : car.iou_after - car.iou_before;
}
