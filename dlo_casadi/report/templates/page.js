"use strict";

// ---- residuals: the chosen pose -----------------------------------------------------------------

const choice = document.getElementById("pose-choice");

function choosePose(value) {
  choice.value = value;
  document.getElementById("chart-residuals").classList.toggle("choosing", value !== "");
  for (const line of document.querySelectorAll("[id^=residual-]")) {
    line.classList.toggle("chosen", line.id.split("-")[2] === value);
    if (line.matches(".chosen")) line.parentNode.append(line); // above all others
  }
  const facts = value === "" ? null : document.querySelector(`#pose-${value} .facts`);
  document.getElementById("pose-said").textContent = facts === null ? "" :
    [...facts.children].map((row) => [...row.children].map((x) => x.textContent).join(" ")).join("; ");
}

function stepPose(by) {
  const known = [...choice.options].filter((option) => !option.disabled);
  const at = known.findIndex((option) => option.value === choice.value);
  choosePose(known[(at + by + known.length) % known.length].value);
}

if (choice) {
  choosePose(""); // a browser may remember another choice
  choice.addEventListener("change", () => choosePose(choice.value));
  document.getElementById("pose-previous").addEventListener("click", () => stepPose(-1));
  document.getElementById("pose-next").addEventListener("click", () => stepPose(1));
  for (const link of document.querySelectorAll("[data-choose]")) {
    link.addEventListener("click", () => choosePose(link.dataset.choose));
  }
  for (const row of document.querySelectorAll("[id^=choose-]")) {
    row.addEventListener("click", () => {
      choosePose(row.id.split("-")[1]);
      document.getElementById("residuals").scrollIntoView();
    });
  }
}

// ---- pictures: what they show -------------------------------------------------------------------

function numbers(points) {
  return points.split(" ").filter(Boolean).map((pair) => pair.split(",").map(Number));
}

// Predictions move away from the measured points by the factor; at 1 the whole predicted line.
function enlargeDeviations(factor) {
  for (const line of document.querySelectorAll(".gallery polyline[data-near]")) {
    line.dataset.whole ??= line.getAttribute("points");
    if (factor === 1) {
      line.setAttribute("points", line.dataset.whole);
      continue;
    }
    const measured = numbers(
      line.parentNode.querySelector("[data-kind=measured]").getAttribute("points"));
    const near = numbers(line.dataset.near);
    const moved = measured.map((at, i) => at.map((x, j) => x + factor * (near[i][j] - x)));
    line.setAttribute("points", moved.map((at) => at.map((x) => x.toFixed(2)).join(",")).join(" "));
  }
}

// The part of a photograph with the cable, or all of it.
function showWhole(yes) {
  for (const svg of document.querySelectorAll("svg[data-whole]")) {
    svg.setAttribute("viewBox", yes ? svg.dataset.whole : svg.dataset.cable);
  }
}

for (const form of document.querySelectorAll(".layers")) {
  form.addEventListener("change", (event) => {
    const input = event.target;
    if (input.dataset.layer) {
      if (input.dataset.layer === "whole") showWhole(input.checked);
      document.body.classList.toggle(`no-${input.dataset.layer}`, !input.checked);
      for (const twin of document.querySelectorAll(`[data-layer=${input.dataset.layer}]`)) {
        twin.checked = input.checked;
      }
    } else {
      enlargeDeviations(Number(input.value));
      for (const twin of document.querySelectorAll(`.layers [type=radio][value="${input.value}"]`)) {
        twin.checked = true;
      }
    }
  });
}

// ---- pictures: large ----------------------------------------------------------------------------

const large = document.getElementById("large");
const enlargers = [...document.querySelectorAll(".enlarge")];
let shown = 0;

function showLarge(k) {
  shown = (k + enlargers.length) % enlargers.length;
  const figure = enlargers[shown].closest("figure");
  const picture = figure.querySelector(".picture").cloneNode(true);
  picture.querySelector("defs")?.remove(); // the lines are those of the small picture
  const box = picture.querySelector("svg").viewBox.baseVal;
  picture.style.maxWidth = `calc(72vh * ${box.width / box.height})`;
  document.getElementById("large-title").textContent = figure.querySelector("h3").textContent;
  document.getElementById("large-picture").replaceChildren(picture);
  const caption = [...figure.querySelectorAll(".facts, .problem, .note")];
  document.getElementById("large-caption").replaceChildren(...caption.map((x) => x.cloneNode(true)));
  if (!large.open) large.showModal();
}

if (large) {
  enlargers.forEach((button, k) => button.addEventListener("click", () => showLarge(k)));
  document.getElementById("large-close").addEventListener("click", () => large.close());
  document.getElementById("large-previous").addEventListener("click", () => showLarge(shown - 1));
  document.getElementById("large-next").addEventListener("click", () => showLarge(shown + 1));
  large.addEventListener("keydown", (event) => {
    if (event.target.matches("input")) return;
    if (event.key === "ArrowLeft") showLarge(shown - 1);
    if (event.key === "ArrowRight") showLarge(shown + 1);
  });
  large.addEventListener("click", (event) => {
    if (event.target === large) large.close(); // a click beside it
  });
  large.addEventListener("close", () => enlargers[shown].focus());
}
