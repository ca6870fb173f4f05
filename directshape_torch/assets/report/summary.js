// This module shows the top of the page: counts, mean errors, notes, failed frames, settings.

import { element, byId } from "report/dom";
import { cars, run, tracks } from "report/data";
import { change, counted, percent, tone } from "report/format";

export function showSummary() {
  byId("title").textContent = `Refined cars: ${run.name}`;
  byId("subtitle").textContent = `${counted(run.frames_done, "frame")}, ${counted(run.cars, "car")}, ${run.refined} refined`;
  byId("made-by").textContent =
    `Written by directshape_torch (results of version ${run.package_version}). 3D views by three.js, MIT licence.`;
  byId("summary").append(...[tiles(), judged(), verdict(), rig(), notes(), failures(), statuses(), settings()].filter((part) => part !== null));
}

function tiles() {
  const failed = Object.keys(run.failed).length;
  const entries = [
    ["Frames", failed ? `${run.frames_done} done, ${failed} failed` : String(run.frames_done), failed ? "bad" : null],
    ["Cars", String(run.cars)],
    ["Refined", run.cars ? `${run.refined} (${percent(run.refined / run.cars)})` : "0"],
  ];
  if (tracks.length) {
    const split = new Set(cars.filter((car) => car.track_part > 0).map((car) => car.track)).size;
    entries.push(["Tracks", split ? `${tracks.length}, ${split} split` : String(tracks.length), split ? "bad" : null]);
  }
  const errors = run.errors;
  if (errors !== null) {
    entries.push(
      [`BEV IoU, mean of ${errors.cars}`, change(errors.iou_before, errors.iou_after), tone(errors.iou_before, errors.iou_after, true)],
      ["BEV IoU above 0.7", shares(errors), tone(errors["share_over_0.7_before"], errors["share_over_0.7_after"], true)],
      ["Centre error, mean", `${change(errors.centre_before_m, errors.centre_after_m)} m`, tone(errors.centre_before_m, errors.centre_after_m)],
      ["Heading error, mean", `${change(errors.yaw_before_deg, errors.yaw_after_deg, 1)}°`, tone(errors.yaw_before_deg, errors.yaw_after_deg, false, 0.05)],
      ...(errors.worse === null ? [] : [[`IoU worse by ${errors.worse_by_iou}`, `${errors.worse} of ${errors.cars} cars`, errors.worse ? "bad" : "good"]]),
    );
  }
  return element("dl", { class: "tiles" }, ...entries.map(([name, value, kind]) =>
    element("div", { class: "tile" }, element("dt", {}, name), element("dd", { class: kind ?? null }, value))));
}

function judged() {
  if (run.errors === null || run.errors.cars === run.cars) return null;
  const of = counted(run.errors.cars, "car");
  const rule = "at least 25 px high, at most partly hidden and at most half outside of the image";
  return element("p", { class: "quiet", id: "judged" }, `IoU and errors above are of the ${of} whose label is ${rule}; the table holds all.`);
}

function shares(errors) {
  const after = percent(errors["share_over_0.7_after"]);
  return errors["share_over_0.7_before"] === null ? after : `${percent(errors["share_over_0.7_before"])} → ${after}`;
}

function notes() {
  if (!run.notes.length) return null;
  return element("div", { class: "notice", id: "notes" }, element("strong", {}, "What this page lacks"),
    element("ul", {}, ...run.notes.map((note) => element("li", {}, note))));
}

function verdict() {
  if (!run.verdict.length) return null;
  return element("div", { class: "notice", id: "verdict" }, element("strong", {}, "What to think of this run, without labels"),
    element("ul", {}, ...run.verdict.map((sentence) => element("li", {}, sentence))));
}

function rig() {
  if (run.rig === null) return null;
  const words = run.rig.words.map((line) => element("p", {}, line));
  if (run.rig.picture === null) return element("div", { id: "rig" }, ...words);
  const title = "Disparity field of the rig, and the detections behind it";
  const picture = element("img", { src: run.rig.picture, alt: title });
  return element("div", { id: "rig" }, ...words, element("details", {}, element("summary", {}, title), picture));
}

function failures() {
  const failed = Object.entries(run.failed);
  if (!failed.length) return null;
  return element("details", { id: "failed" }, element("summary", {}, `Failed frames (${failed.length})`),
    factTable(failed, ["Frame", "Reason"]));
}

function statuses() {
  if (!run.statuses.length) return null;
  return element("details", { id: "statuses" }, element("summary", {}, "How the cars ended"),
    factTable(run.statuses.map((status) => [status.name, `${status.count}: ${status.meaning}`]), ["Status", "Cars"]));
}

function settings() {
  const rows = [
    ...Object.entries(run.sha256).map(([name, hash]) => [`sha256 of ${name}`, hash ?? "none"]),
    ...Object.entries(run.ground_sources).map(([name, count]) => [`ground from ${name}`, counted(count, "frame")]),
    ...Object.entries(run.settings),
  ];
  return element("details", { id: "settings" }, element("summary", {}, "Settings of the run"),
    factTable(rows, ["Setting", "Value"]));
}

export function factTable(rows, heads) {
  return element("table", { class: "facts" },
    element("thead", {}, element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head)))),
    element("tbody", {}, ...rows.map(([name, ...values]) =>
      element("tr", {}, element("th", { scope: "row" }, name), ...values.map((value) => element("td", {}, value))))));
}
