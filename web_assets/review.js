// Keys and place of the bar of a take under review. Runs again after each reconnection.
//
// The server writes `<i data-press="ArrowLeft Space">` before a row of buttons: these keys click them, in
// their order. While such a mark is on the page, keys that drive the robot do nothing in this browser.
(() => {
  const style = document.getElementById("review-style") ?? document.head.appendChild(document.createElement("style"));
  style.id = "review-style";
  style.textContent = REVIEW_CSS;
  if (window.reviewPage) return;
  window.reviewPage = true;

  // Under the scene, between the panels
  setInterval(() => {
    if (!document.querySelector(".readout")) return;
    const view = document.querySelector("canvas").getBoundingClientRect();
    document.documentElement.style.setProperty("--view-left", `${view.left}px`);
    document.documentElement.style.setProperty("--view-width", `${view.width}px`);
  }, 100);

  const CAMERA = /^Key[WASDQE]$/;  // viser moves its camera by them
  const DRIVES = /^(Key[A-Z]|Digit[0-9])$/;
  const GAP = 60;  // [ms] viser forgets a click that comes within 50 after another
  let free = 0;  // when the next click will count

  addEventListener("keydown", (event) => {
    const mark = document.querySelector("[data-press]");
    if (!mark || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target instanceof Element && event.target.closest("input, textarea, select, [contenteditable=true]")) return;
    const index = mark.dataset.press.split(" ").indexOf(event.code);
    if (index < 0) {
      if (DRIVES.test(event.code) && !CAMERA.test(event.code)) event.stopImmediatePropagation();
      return;
    }
    event.stopImmediatePropagation();  // the arrows would turn viser's camera, too
    event.preventDefault();
    const now = performance.now();
    if (event.repeat && (event.code === "Space" || free > now)) return;
    setTimeout(() => press(index), free - now);
    free = Math.max(free, now) + GAP;
  }, true);

  function press(index) {
    let element = document.querySelector("[data-press]")?.parentElement;
    for (let step = 0; step <= index; step++) element = element?.nextElementSibling;
    element?.querySelector("button:not(:disabled)")?.click();
  }
})();
