"use strict";

// ---- pictures of rooms: turned together ---------------------------------------------------------

const DEGREES_A_WIDTH = 240; // turned by a drag across a whole picture
const STILL = 4; // px, a pointer that moves less has not dragged
const view = { azimuth: 0, elevation: 0 };
let drag = null;

// From far away: right = (-sin a, cos a, 0), up = (-sin e cos a, -sin e sin a, cos e).
function seenFrom(azimuth, elevation) {
  const [a, e] = [azimuth * Math.PI / 180, elevation * Math.PI / 180];
  const [sa, ca, se, ce] = [Math.sin(a), Math.cos(a), Math.sin(e), Math.cos(e)];
  return ([x, y, z]) =>
    `${(ca * y - sa * x).toFixed(2)},${(se * (ca * x + sa * y) - ce * z).toFixed(2)}`;
}

function drawRooms() {
  const seen = seenFrom(view.azimuth, view.elevation);
  const flat = (node, key) => {
    node[key] ??= numbers(node.dataset[key]);
    return node[key].map(seen).join(" ");
  };
  for (const node of document.querySelectorAll("[data-solid]")) {
    const points = flat(node, "solid");
    if (node.tagName === "text") node.setAttribute("transform", `translate(${points})`);
    else node.setAttribute("points", points);
    if (node.dataset.nearSolid) {
      node.dataset.near = flat(node, "nearSolid");
      node.dataset.whole = points;
    }
  }
  const factor = Number(document.querySelector(".layers [type=radio]:checked")?.value ?? 1);
  if (factor !== 1) enlargeDeviations(factor);
}

function turnRooms(azimuth, elevation) {
  view.azimuth = azimuth;
  view.elevation = Math.max(-90, Math.min(90, elevation));
  requestAnimationFrame(drawRooms);
}

for (const button of document.querySelectorAll("[data-view]")) {
  button.addEventListener("click", () => turnRooms(...button.dataset.view.split(" ").map(Number)));
}
[view.azimuth, view.elevation] =
  document.querySelector("[data-view]").dataset.view.split(" ").map(Number);

// A button takes the pointer for what is in it.
function roomAt(target) {
  return target.closest?.(".room") ?? target.closest?.(".enlarge")?.querySelector(".room");
}

addEventListener("pointerdown", (event) => {
  const room = event.isPrimary && event.button === 0 ? roomAt(event.target) : null;
  drag = room && { room, x: event.clientX, y: event.clientY, ...view, moved: false };
});
addEventListener("pointermove", (event) => {
  if (!drag || !event.isPrimary) return;
  const [right, down] = [event.clientX - drag.x, event.clientY - drag.y];
  drag.moved ||= Math.hypot(right, down) > STILL;
  if (!drag.moved) return;
  drag.room.classList.add("turning");
  const degrees = DEGREES_A_WIDTH / drag.room.clientWidth;
  turnRooms(drag.azimuth - degrees * right, drag.elevation + degrees * down);
});
for (const name of ["pointerup", "pointercancel"]) {
  addEventListener(name, () => {
    drag?.room.classList.remove("turning");
    // The click that follows a drag must neither open nor close anything; it comes before the timer.
    const done = drag;
    setTimeout(() => { if (drag === done) drag = null; });
    if (done && !done.moved) drag = null;
  });
}
addEventListener("click", (event) => {
  if (!drag?.moved) return;
  event.preventDefault();
  event.stopPropagation();
}, true);
