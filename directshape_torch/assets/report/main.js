// This module builds the page, section by section.

import { showSummary } from "report/summary";
import { showDistributions } from "report/charts";
import { showHighlights } from "report/highlights";
import { showFrames } from "report/frame_view";
import { showTable } from "report/table";
import { openCar } from "report/car_dialog";

showSummary();
showDistributions();
showHighlights();
showFrames(openCar);
showTable();
document.documentElement.dataset.ready = "true";
