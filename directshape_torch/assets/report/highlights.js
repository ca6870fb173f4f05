// This module shows the cars that gained most and least.

import { element, byId } from "report/dom";
import { cars, hasErrorsBefore } from "report/data";
import { carName, change, gain, iouChange, number, percent, signed, tone } from "report/format";
import { pair } from "report/thumbnails";
import { openCar } from "report/car_dialog";

const COUNT = 4;

export function showHighlights() {
  const value = (car) => gain(car, hasErrorsBefore);
  const ranked = cars.filter((car) => value(car) !== null && (car.counts || !hasErrorsBefore)).sort((a, b) => value(b) - value(a));
  const place = byId("highlights");
  if (!ranked.length) {
    place.append(element("p", {}, "No car can be ranked."));
    return;
  }
  const rule = hasErrorsBefore
    ? "By the change of the bird's-eye IoU with the label, of the cars that the summary counts."
    : "By the calibrated probability that the result is not worse than the input.";
  const better = ranked.filter((car) => !hasErrorsBefore || value(car) > 0).length;
  const half = Math.min(COUNT, Math.ceil(ranked.length / 2));
  place.append(element("p", { class: "quiet" }, rule),
    element("h3", {}, "Best"), cards(ranked.slice(0, Math.min(half, better)), "No car became better."),
    element("h3", {}, "Worst"), cards(ranked.slice(half).slice(-half).reverse(), "No further car."));
}

function cards(chosen, none) {
  if (!chosen.length) return element("p", { class: "quiet" }, none);
  return element("ul", { class: "cards" }, ...chosen.map((car) => element("li", {},
    element("button", { class: "card", type: "button", onclick: () => openCar(car) }, pair(car),
      element("strong", {}, carName(car)), figures(car)))));
}

function figures(car) {
  const words = car.iou_before !== null && car.iou_after !== null
    ? [`IoU ${change(car.iou_before, car.iou_after)} (${signed(iouChange(car))})`, tone(car.iou_before, car.iou_after, true)]
    : [`probably not worse: ${percent(car.probability_not_worse)}`, null];
  return element("span", {}, element("span", { class: words[1] }, words[0]), `, ${number(car.distance_m, 1)} m, ${car.status}`);
}
