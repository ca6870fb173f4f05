// This module shows one car in full: pictures, residual maps, figures, costs by term and the disparity profile.

import { element } from "report/dom";
import { mapsOf, thumbnailsOf } from "report/data";
import { carName, change, costChange, iouChange, number, percent, signed, tone, trackName } from "report/format";
import { curves } from "report/charts";
import { factTable } from "report/summary";
import { showCarInFrame } from "report/frame_view";

const dialog = element("dialog", { id: "car-dialog", "aria-labelledby": "car-dialog-title" });
dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
document.body.append(dialog);

export function openCar(car) {
  const maps = mapsOf(car);
  dialog.replaceChildren(
    element("div", { class: "dialog-head" },
      element("h2", { id: "car-dialog-title" }, `Car ${carName(car)}`),
      element("button", { type: "button", id: "close-car", onclick: () => dialog.close() }, "Close")),
    element("p", {}, `${car.type}, ${number(car.distance_m, 1)} m away: ${car.status}. `, element("span", { class: "quiet" }, maps?.message ?? "")),
    buttons(car, maps),
    pictures(car),
    element("div", { id: "residual-maps" }),
    element("h3", {}, "Figures"), figures(car, maps),
    ...(maps === null ? [element("p", { class: "quiet" }, "No pictures of this frame are in the page (--max-frames).")] : [costs(maps), profile(maps)]),
  );
  if (!dialog.open) dialog.showModal();
  dialog.scrollTop = 0;
}

function buttons(car, maps) {
  const known = maps !== null && Object.keys(maps.pictures).length > 0;
  return element("p", { class: "controls" },
    element("button", { type: "button", id: "show-maps", disabled: !known, "aria-expanded": "false", onclick: (event) => toggleMaps(event.currentTarget, car, maps) },
      known ? "Show residual maps" : "No residual maps"),
    element("button", { type: "button", id: "show-in-3d", disabled: maps === null, onclick: () => { dialog.close(); showCarInFrame(car); } }, "Show in 3D"));
}

function pictures(car) {
  const urls = thumbnailsOf(car);
  return element("div", { class: "large" }, ...["before", "after"].filter((name) => urls[name]).map((name) =>
    captioned(urls[name], `Car ${carName(car)} ${name}, with its contour`, name, null, name)));
}

function toggleMaps(button, car, maps) {
  const place = document.getElementById("residual-maps");
  const open = place.childElementCount === 0;
  place.replaceChildren(...(open ? residualMaps(car, maps) : []));
  button.setAttribute("aria-expanded", String(open));
  button.textContent = open ? "Hide residual maps" : "Show residual maps";
}

const KINDS = [
  ["photometric", "Photometric residual", "right image darker than the left one, warped by the shape", "brighter (white: they agree; full colour from 30 grey levels)"],
  ["silhouette", "Silhouette residual", "mask that the shape does not fill", "shape that spills out of its mask"],
];

function residualMaps(car, maps) {
  return KINDS.flatMap(([kind, title, low, high]) => {
    const found = ["before", "after"].filter((name) => maps.pictures[`${kind}_${name}`]);
    if (!found.length) return [];
    return [element("h3", {}, title),
      element("p", { class: "quiet" }, low, element("span", { class: `scale ${kind}`, "aria-hidden": "true" }), high),
      element("div", { class: "large" }, ...found.map((name) =>
        captioned(maps.pictures[`${kind}_${name}`], `${title} of car ${carName(car)} ${name}`, name, "map", name)))];
  });
}

function captioned(url, alt, caption, kind, tone) {
  return element("figure", {}, element("figcaption", { class: tone }, caption), element("img", { src: url, alt, class: kind }));
}

function figures(car, maps) {
  const sigmas = maps?.sigmas_ref ?? [null, null, null, null];
  const rows = [
    ["Length, width, height", `${number(car.length_m)}, ${number(car.width_m)}, ${number(car.height_m)} m`],
    ["Probably better than the input", percent(car.probability_better)],
    ["Probably not worse", percent(car.probability_not_worse)],
    ...(car.probability_heading === null ? [] : [["Front is where the box has it", percent(car.probability_heading)]]),
    ["Standard deviations from the detector's box", number(car.distance_in_sigmas, 1)],
    ["IoU with the mask", number(car.mask_iou)],
    ["Difference of the images", `${number(car.photometric_error_grey, 1)} grey levels`],
    ["Standard deviation of x, y, z", `${sigmas.slice(0, 3).map((sigma) => number(sigma)).join(", ")} m`],
    ["Standard deviation of the heading", sigmas[3] === null ? "–" : `${number(sigmas[3] * 180 / Math.PI, 1)}°`],
    ["Least seen", car.unseen || "–"],
    ...(car.track ? [["Track", trackName(car)]] : []),
    ["Score of the detector", number(car.score)],
    ["Iterations", String(car.iterations)],
    ["Cost", `${change(car.cost_before, car.cost_after)} (${percent(costChange(car))})`],
  ];
  if (car.iou_after !== null) {
    const judged = (words, ...compared) => element("span", { class: tone(...compared) }, words);
    const iou = `${change(car.iou_before, car.iou_after)}${car.iou_before === null ? "" : ` (${signed(iouChange(car))})`}`;
    rows.push(["Bird's-eye IoU with the label", judged(iou, car.iou_before, car.iou_after, true)],
      ["Centre error", judged(`${change(car.centre_before_m, car.centre_after_m)} m`, car.centre_before_m, car.centre_after_m)],
      ["Heading error", judged(`${change(car.yaw_before_deg, car.yaw_after_deg, 1)}°`, car.yaw_before_deg, car.yaw_after_deg, false, 0.05)]);
  }
  return factTable(rows, ["Figure", "Value"]);
}

function costs(maps) {
  const rows = maps.terms.map((name, index) => [name, number(maps.costs_before[index], 3), number(maps.costs_after[index], 3)]);
  return element("div", {}, element("h3", {}, "Cost by term"), factTable(rows, ["Term", "Before", "After"]));
}

function profile(maps) {
  return curves("Photometric cost if the whole car had another disparity", "px", maps.profile_offsets_px,
    [["before", maps.profile_before], ["after", maps.profile_after]]) ?? "";
}
