// This module shows one frame at a time: its picture, and its cars in 3D.

import { element, byId } from "report/dom";
import { carsOfFrame, frames, pathOf, sceneOf, tracks } from "report/data";
import { carName, counted } from "report/format";
import { framePicture } from "report/frame_picture";

const shown = { before: true, after: true, truth: true };
const picture = element("div", { id: "frame-picture" });
const host = element("div", { class: "scene", id: "scene" });
const choice = element("select", { id: "frame-choice", onchange: () => showFrame(Number(choice.value)) });
const caption = element("p", { class: "quiet", role: "status", id: "frame-caption" });
let current = null;
let openCar = null;
let viewer = null;
let started = null;

// `open` shows a car in full; it is set later, because the dialog itself needs this module.
export function showFrames(open) {
  openCar = open;
  const place = byId("frames");
  if (!frames.detailed.length) {
    place.append(element("p", {}, "No frame has details in this page."));
    return;
  }
  choice.append(...frames.detailed.map((number) => element("option", { value: number }, frames.ids[number])));
  place.append(controls(), caption, element("div", { class: "frame-stage" }, picture, host), viewControls());
  // The viewer starts when it is scrolled near the window, not with the page.
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    startViewer();
  }, { rootMargin: "400px" }).observe(host);
  showFrame(frames.detailed[0]);
}

function controls() {
  const step = (by, text, id) => element("button", { type: "button", id, onclick: () => {
    const position = frames.detailed.indexOf(current) + by;
    showFrame(frames.detailed[(position + frames.detailed.length) % frames.detailed.length]);
  } }, text);
  const toggles = Object.keys(shown).map((name) => element("label", { class: name },
    element("input", { type: "checkbox", id: `show-${name}`, checked: true, onchange: (event) => { shown[name] = event.target.checked; redraw(); } }),
    name === "truth" ? "labels" : name));
  return element("div", { class: "controls" }, step(-1, "◀ Previous", "previous-frame"), element("label", {}, "Frame", choice),
    step(1, "Next ▶", "next-frame"), ...toggles);
}

function viewControls() {
  const view = (name, text) => element("button", { type: "button", id: `view-${name}`, onclick: () => viewer?.lookFrom(name) }, text);
  return element("div", { class: "controls" }, view("behind", "From behind"), view("camera", "From the camera"), view("above", "From above"),
    element("span", { class: "quiet" }, "Drag to turn, wheel or pinch to come nearer, right button or two fingers to move; arrow keys move, with Shift they turn. Select a car to open it."));
}

// The first caller starts the viewer; later callers wait for the same one.
const startViewer = () => started ??= start();

async function start() {
  try {
    const { Viewer } = await import("report/scene3d");
    viewer = new Viewer(host, (place) => openCar(carsOfFrame(current)[place]));
    await drawScene();
  } catch (error) {
    viewer = null;
    console.warn(error);
    host.replaceChildren(element("p", { class: "notice" }, `No 3D view: ${error.message}`));
  }
}

function drawScene() {
  const inFrame = carsOfFrame(current);
  const paints = inFrame.map((car, place) => car.track ? tracks.indexOf(car.track) : place);
  return viewer?.show(sceneOf(current), shown, `Frame ${frames.ids[current]} in 3D`, paints, inFrame.map(pathOf));
}

async function showFrame(number) {
  current = number;
  choice.value = String(number);
  await redraw();
  if (current === number) viewer?.lookFrom("behind");
}

// The promise resolves when the 3D view is up to date.
function redraw() {
  const scene = sceneOf(current), inFrame = carsOfFrame(current);
  picture.replaceChildren(scene.image === null
    ? element("p", { class: "quiet" }, "The image of this frame is not in the page.")
    : framePicture(scene, inFrame, shown, openCar));
  caption.textContent = `Frame ${frames.ids[current]}: ${counted(inFrame.length, "car")}. ${groundWords(scene)}`;
  return drawScene();
}

function groundWords(scene) {
  return scene.ground === null
    ? "The ground plane is not at hand; the grid is level, at the height of the cars."
    : `Grid: 5 m, on the ground plane (from ${scene.ground_source}).`;
}

export async function showCarInFrame(car) {
  byId("scene").scrollIntoView({ block: "center" });
  await startViewer();
  if (current !== car.frame) await showFrame(car.frame);
  if (current === car.frame) viewer?.lookAtCar(car.place, carName(car));
}
