// This module shows all cars, with a filter and sorting by any column, a hundred rows at a time.

import { element, byId } from "report/dom";
import { cars, run, hasLabels, hasErrorsBefore, tracks } from "report/data";
import { MISSING, costChange, iouChange, number, percent, signed, tone, trackName } from "report/format";
import { thumbnail } from "report/thumbnails";
import { openCar } from "report/car_dialog";

const ROWS_AT_ONCE = 100;

const numeric = (title, value, text = (car) => number(value(car)), toneOf = () => null) => ({ title, value, text, toneOf, kind: "number" });
const words = (title, value, kind = "words") => ({ title, value, text: value, kind });

const iouTone = (car) => tone(car.iou_before, car.iou_after, true);
// The name of the frame contains the sequence.
const trackNumber = (car) => trackName(car).replace(/^(.*_)?0*(?=\d)/, "");
const columns = [
  ...(tracks.length ? [{ title: "Track", value: (car) => car.track, text: trackNumber, kind: "type" }] : []),
  numeric("Distance [m]", (car) => car.distance_m, (car) => number(car.distance_m, 1)),
  words("Status", (car) => car.status, "status"),
  ...(hasErrorsBefore ? [numeric("IoU before", (car) => car.iou_before)] : []),
  ...(hasLabels ? [numeric("IoU after", (car) => car.iou_after, undefined, iouTone)] : []),
  ...(hasErrorsBefore ? [numeric("IoU change", iouChange, (car) => signed(iouChange(car)), iouTone)] : []),
  ...(hasErrorsBefore ? [numeric("Centre error before [m]", (car) => car.centre_before_m)] : []),
  ...(hasLabels ? [numeric("Centre error after [m]", (car) => car.centre_after_m, undefined, (car) => tone(car.centre_before_m, car.centre_after_m))] : []),
  numeric("Cost change", costChange, (car) => percent(costChange(car))),
  numeric("Probably better", (car) => car.probability_better, (car) => percent(car.probability_better)),
  numeric("Probably not worse", (car) => car.probability_not_worse, (car) => percent(car.probability_not_worse)),
  numeric("Mask IoU", (car) => car.mask_iou),
  numeric("Image difference [grey]", (car) => car.photometric_error_grey, (car) => number(car.photometric_error_grey, 1)),
  numeric("Sigma of depth [m]", (car) => car.sigma_depth_m),
  numeric("Length [m]", (car) => car.length_m),
  words("Type", (car) => car.type, "type"),
  words("Least seen", (car) => car.unseen),
];
const nameColumn = { title: "Car", value: (car) => `${car.frameId} ${String(car.line).padStart(4, "0")}` };

const state = { column: null, descending: false, shown: ROWS_AT_ONCE, search: "", status: "" };
const body = element("tbody", { id: "car-rows" });
const counter = element("p", { class: "quiet", role: "status", id: "car-count" });
const more = element("button", { type: "button", class: "more", onclick: () => { state.shown += ROWS_AT_ONCE; render(); } }, "Show more");
const heads = new Map();

export function showTable() {
  byId("cars").append(controls(), counter,
    element("div", { class: "scroller", tabindex: "0", role: "region", "aria-label": "Table of cars" },
      element("table", { class: "cars" }, element("caption", { class: "quiet" }, element("span", {}, "Select a heading to sort; select a car for its pictures, residual maps and figures.")),
        element("thead", {}, element("tr", {}, head(nameColumn),
          element("th", { scope: "col" }, "Before"), element("th", { scope: "col" }, "After"), ...columns.map(head))), body)),
    more);
  render();
}

function controls() {
  const search = element("input", { id: "search", type: "search", oninput: (event) => { state.search = event.target.value.toLowerCase(); restart(); } });
  const choose = element("select", { id: "status-filter", onchange: (event) => { state.status = event.target.value; restart(); } },
    element("option", { value: "" }, "all"), ...run.statuses.map((status) => element("option", { value: status.name }, status.name)));
  return element("div", { class: "controls" },
    element("label", {}, tracks.length ? "Frame, track or type" : "Frame or type", search), element("label", {}, "Status", choose),
    element("label", { class: "narrow" }, "Sort by", sortChoice()));
}

// The head of the table is too wide for a phone.
function sortChoice() {
  const options = [nameColumn, ...columns].map((column, index) => element("option", { value: index }, column.title));
  return element("select", { id: "sort-choice", onchange: (event) => sortBy([nameColumn, ...columns][Number(event.target.value)]) }, ...options);
}

function restart() {
  state.shown = ROWS_AT_ONCE;
  render();
}

function head(column) {
  const arrow = element("span", { class: "arrow", "aria-hidden": "true" });
  const cell = element("th", { scope: "col", "aria-sort": "none" },
    element("button", { type: "button", onclick: () => sortBy(column) }, column.title, arrow));
  heads.set(column, { cell, arrow });
  return cell;
}

function sortBy(column) {
  // The first click sorts numbers from the largest and words by the alphabet.
  state.descending = state.column === column ? !state.descending : column.kind === "number";
  state.column = column;
  for (const [other, { cell, arrow }] of heads) {
    const chosen = other === column;
    cell.setAttribute("aria-sort", chosen ? (state.descending ? "descending" : "ascending") : "none");
    arrow.textContent = chosen ? (state.descending ? " ▼" : " ▲") : "";
  }
  restart();
}

function chosenCars() {
  const found = cars.filter((car) => (state.status === "" || car.status === state.status)
    && (state.search === "" || `${car.frameId} ${car.type}${car.track && ` track ${trackName(car)}`}`.toLowerCase().includes(state.search)));
  return state.column === null ? found : found.sort((a, b) => compare(state.column.value(a), state.column.value(b)) || a.index - b.index);
}

// Unknown values come last in both orders.
function compare(a, b) {
  if (a === null || b === null) return (a === null) - (b === null);
  const order = typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b;
  return state.descending ? -order : order;
}

function render() {
  const found = chosenCars();
  body.replaceChildren(...found.slice(0, state.shown).map(row));
  const shown = Math.min(state.shown, found.length);
  counter.textContent = `${shown} of ${found.length} cars shown${found.length < cars.length ? `, ${cars.length} in all` : ""}`;
  more.hidden = shown >= found.length;
}

function row(car) {
  return element("tr", {},
    element("td", { class: "name" }, element("button", { type: "button", class: "open-car", onclick: () => openCar(car) },
      element("span", {}, car.frameId), " ", element("span", { class: "quiet" }, `line ${car.line}`))),
    element("td", { class: "picture" }, thumbnail(car, "before")), element("td", { class: "picture" }, thumbnail(car, "after")),
    ...columns.map((column) => element("td", { class: [column.kind, column.toneOf?.(car)].filter(Boolean).join(" "), "data-title": column.title }, column.text(car) || MISSING)));
}
