// This module shows small pictures of cars, created when they come into view.

import { element } from "report/dom";
import { thumbnailsOf } from "report/data";
import { carName } from "report/format";

const waiting = new Map();
const observer = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    const load = waiting.get(entry.target);
    observer.unobserve(entry.target);
    waiting.delete(entry.target);
    load?.();
  }
}, { rootMargin: "300px" });

// Creates the picture of a car "before" or "after"; `whenMissing` is called if there is none.
export function thumbnail(car, name) {
  const words = name === "before" ? "before, the detection with the mean shape" : "after the refinement";
  const image = element("img", { class: "thumbnail", alt: `Car ${carName(car)} ${words}`, decoding: "async", width: 110, height: 73 });
  image.dataset.car = car.index;
  waiting.set(image, () => {
    const url = thumbnailsOf(car)[name];
    if (url) image.src = url;
    else image.replaceWith(element("span", { class: "quiet" }, "no picture"));
  });
  observer.observe(image);
  return image;
}

export const pair = (car) => element("span", { class: "pair" }, thumbnail(car, "before"), thumbnail(car, "after"));
