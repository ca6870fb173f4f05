// This module formats numbers and names for the page.

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

// The sign is always shown, so that a loss is recognised.
export function signed(value, decimals = 2) {
  if (value === null || value === undefined) return MISSING;
  const digits = Math.abs(value).toFixed(decimals);
  return Number(digits) === 0 ? digits : `${value > 0 ? "+" : "-"}${digits}`;
}

// Returns "good", "bad" or nothing: whether `after` is better than `before` by more than the shown digits. Smaller
// values are better, except for IoU.
export function tone(before, after, moreIsBetter = false, least = 0.005) {
  if (before === null || before === undefined || after === null || after === undefined) return null;
  const gained = moreIsBetter ? after - before : before - after;
  return Math.abs(gained) < least ? null : gained > 0 ? "good" : "bad";
}

export const iouChange = (car) => (car.iou_before === null || car.iou_after === null ? null : car.iou_after - car.iou_before);

export const carName = (car) => `${car.frameId}, line ${car.line}`;

// Later parts of a track that was split are other cars; a car "alone" shares no shape.
export const trackName = (car) => car.track && `${car.track}${car.track_part > 0 ? `, part ${car.track_part}` : car.track_part < 0 ? ", alone" : ""}`;

export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

// Returns the relative change of the cost, or null.
export function costChange(car) {
  return car.cost_before > 0 && car.cost_after !== null ? car.cost_after / car.cost_before - 1 : null;
}

// Returns the improvement of a car: by its label if the run has labels, else by its probability. `car_gains` of
// car_rows.py has the same rule.
export function gain(car, byLabels) {
  if (!car.refined) return null;
  if (!byLabels) return car.probability_not_worse;
  return iouChange(car);
}
