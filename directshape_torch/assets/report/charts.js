// This module draws distributions as SVG: histograms of two series, bars of counts, and curves.

import { element, svg, byId } from "report/dom";
import { cars, run, hasLabels } from "report/data";
import { costChange, iouChange, number } from "report/format";

const WIDTH = 340, HEIGHT = 180;
const MARGIN = { left: 36, right: 10, top: 8, bottom: 30 };

export function showDistributions() {
  const charts = element("div", { class: "charts" });
  byId("distributions").append(charts);
  if (!cars.length) {
    charts.append(element("p", {}, "No cars."));
    return;
  }
  const judged = cars.filter((car) => car.counts);
  if (hasLabels && judged.length) {
    charts.append(
      histogram("Bird's-eye IoU", judged, "iou_before", "iou_after", 0, 1, ""),
      changes(judged.map(iouChange).filter((value) => value !== null)),
      histogram("Centre error", judged, "centre_before_m", "centre_after_m", 0, null, "m"),
    );
  } else {
    charts.append(plainHistogram("Change of the cost", cars.map(costChange).map((v) => v === null ? null : 100 * v), -100, 0, "%"));
  }
  charts.append(
    histogram("Distance", cars.map((car) => ({ rest: car.refined ? null : car.distance_m, done: car.refined ? car.distance_m : null })),
      "rest", "done", 0, null, "m", [["other", "not refined"], ["after", "refined"]], true),
    bars("Status", run.statuses.map((status) => [status.name, status.count])),
  );
}

const KEYS = [["before", "before"], ["after", "after"]];

function histogram(title, rows, first, second, low, high, unit, keys = KEYS, stacked = false) {
  const series = [first, second].map((name) => rows.map((row) => row[name]).filter((value) => value !== null));
  const all = series.flat().sort((a, b) => a - b);
  // A few far outliers among many values are counted in the last bar, which says so.
  const top = high ?? niceCeiling(all[Math.ceil(0.97 * (all.length - 1))] ?? 1);
  const open = (all[all.length - 1] ?? 0) > top;
  const counts = series.map((values) => binned(values, low, top, 14));
  return figure(title, unit, keys.filter((_, index) => series[index].length),
    drawnBars(counts, keys, low, top, open, stacked), describe(title, unit, keys, series));
}

// The histogram has losses in red to the left of 0, and gains to the right.
function changes(values) {
  if (!values.length) return "";
  const most = niceCeiling(Math.max(...values.map(Math.abs)));
  const rows = values.map((value) => ({ lost: value < 0 ? value : null, gained: value < 0 ? null : value }));
  return histogram("Change of the IoU", rows, "lost", "gained", -most, most, "", [["bad", "worse"], ["good", "better"]], true);
}

function plainHistogram(title, values, low, high, unit) {
  const known = values.filter((value) => value !== null);
  const counts = [binned(known, low, high, 14)];
  return figure(title, unit, [], drawnBars(counts, [["after", "after"]], low, high, known.some((v) => v > high), false),
    describe(title, unit, [["after", "cars"]], [known]));
}

function binned(values, low, high, count) {
  const bins = new Array(count).fill(0);
  for (const value of values) bins[Math.max(0, Math.min(count - 1, Math.floor(count * (value - low) / (high - low))))] += 1;
  return bins;
}

function drawnBars(counts, keys, low, high, open, stacked) {
  const bins = counts[0].length;
  const total = (bin) => stacked ? counts.reduce((sum, series) => sum + series[bin], 0) : Math.max(...counts.map((series) => series[bin]));
  const peak = Math.max(1, ...counts[0].map((_, bin) => total(bin)));
  const wide = (WIDTH - MARGIN.left - MARGIN.right) / bins;
  const bottom = HEIGHT - MARGIN.bottom, tall = bottom - MARGIN.top;
  const parts = axes(low, high, peak, open);
  for (let bin = 0; bin < bins; bin++) {
    let base = 0;
    counts.forEach((series, index) => {
      const size = tall * series[bin] / peak;
      const narrow = stacked || counts.length === 1 ? wide - 2 : (wide - 2) / 2;
      const x = MARGIN.left + bin * wide + 1 + (stacked ? 0 : index * narrow);
      parts.push(svg("rect", { class: `series-${keys[index][0]}`, x, y: bottom - base - size, width: narrow, height: size },
        svg("title", {}, `${series[bin]} ${keys[index][1]}`)));
      if (stacked) base += size;
    });
  }
  return svg("svg", { class: "chart", viewBox: `0 0 ${WIDTH} ${HEIGHT}` }, ...parts);
}

function axes(low, high, peak, open) {
  const bottom = HEIGHT - MARGIN.bottom, right = WIDTH - MARGIN.right;
  const parts = [
    svg("line", { class: "axis", x1: MARGIN.left, x2: right, y1: bottom, y2: bottom }),
    svg("text", { x: MARGIN.left - 5, y: bottom, "text-anchor": "end" }, "0"),
    svg("text", { x: MARGIN.left - 5, y: MARGIN.top + 9, "text-anchor": "end" }, number(peak, Number.isInteger(peak) ? 0 : 1)),
  ];
  for (let tick = 0; tick <= 4; tick++) {
    const value = low + (high - low) * tick / 4;
    const x = MARGIN.left + (right - MARGIN.left) * tick / 4;
    const text = number(value, high - low > 8 ? 0 : 2) + (open && tick === 4 ? "+" : "");
    parts.push(svg("text", { x, y: bottom + 14, "text-anchor": tick === 4 ? "end" : tick === 0 ? "start" : "middle" }, text));
  }
  return parts;
}

function bars(title, entries) {
  const row = 24, left = 120;
  const height = Math.max(row, entries.length * row);
  const peak = Math.max(1, ...entries.map(([, count]) => count));
  const parts = entries.flatMap(([name, count], index) => [
    svg("text", { x: left - 6, y: index * row + 16, "text-anchor": "end" }, name),
    svg("rect", { class: "series-after", x: left, y: index * row + 4, width: (WIDTH - left - 40) * count / peak, height: row - 8 }),
    svg("text", { x: left + (WIDTH - left - 40) * count / peak + 5, y: index * row + 16 }, String(count)),
  ]);
  const chart = svg("svg", { class: "chart", viewBox: `0 0 ${WIDTH} ${height}` }, ...parts);
  return figure(title, "", [], chart, `${title}: ${entries.map(([name, count]) => `${name} ${count}`).join(", ")}`);
}

// Curves over common positions are [class, values] pairs; a missing value leaves a gap.
export function curves(title, unit, positions, series) {
  const known = series.flatMap(([, values]) => values).filter((value) => value !== null);
  if (!known.length) return null;
  const low = positions[0], high = positions[positions.length - 1], peak = Math.max(...known) || 1;
  const bottom = HEIGHT - MARGIN.bottom, tall = bottom - MARGIN.top;
  const at = (position, value) => [
    MARGIN.left + (WIDTH - MARGIN.left - MARGIN.right) * (position - low) / (high - low || 1),
    bottom - tall * value / peak,
  ].map((coordinate) => coordinate.toFixed(1)).join(",");
  const lines = series.map(([name, values]) => svg("polyline", {
    class: `line-${name}`,
    points: positions.map((position, index) => values[index] === null ? null : at(position, values[index])).filter((p) => p !== null).join(" "),
  }));
  const chart = svg("svg", { class: "chart", viewBox: `0 0 ${WIDTH} ${HEIGHT}` }, ...axes(low, high, peak, false), ...lines);
  return figure(title, unit, series.map(([name]) => [name, name]), chart, title);
}

function figure(title, unit, keys, chart, description) {
  chart.setAttribute("role", "img");
  chart.setAttribute("aria-label", description);
  return element("figure", {},
    element("figcaption", {}, element("strong", {}, unit ? `${title} [${unit}]` : title), " ",
      ...keys.map(([name, text]) => element("span", { class: `key ${name === "other" ? "quiet" : name}` }, text))),
    chart);
}

function describe(title, unit, keys, series) {
  const parts = series.map((values, index) => {
    if (!values.length) return null;
    const sorted = [...values].sort((a, b) => a - b);
    return `${keys[index][1]}: ${values.length} cars, median ${number(sorted[Math.floor(sorted.length / 2)])} ${unit}`;
  });
  return `${title}. ${parts.filter((part) => part !== null).join("; ")}`;
}

function niceCeiling(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 1.2, 1.6, 2, 2.4, 3.2, 4, 6, 8, 10].map((factor) => factor * power).find((candidate) => candidate >= value * 0.999);
}
