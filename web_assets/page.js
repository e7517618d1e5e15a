// What viser's page lacks: our style, a line at the top, sounds, and keys that are held down. Runs again after each
// reconnection.
//
// The server writes marks into the page's HTML; this script reads them and never calls the server itself:
//   <div class="told">…</div>   show a copy of this at the top, also while the panel around it is folded up
//   <i data-sound="12 start">   play the cue "start"; 12 counts, so that each cue plays once
//   <i data-hold="KeyW KeyS">   these keys press and hold the buttons that follow the mark
(() => {
  const style = document.getElementById("studio-style") ?? document.head.appendChild(document.createElement("style"));
  style.id = "studio-style";
  style.textContent = STUDIO_CSS;
  if (window.studioPage) return;
  window.studioPage = true;
  document.title = "Comp-ACT Studio";

  // The status line, and what lies over the scene

  const status = Object.assign(document.createElement("div"), { id: "status" });
  document.body.prepend(status);
  setInterval(() => {
    const told = document.createElement("div");
    for (const part of document.querySelectorAll(".told")) told.append(...part.cloneNode(true).childNodes);
    if (told.innerHTML !== status.innerHTML) status.replaceChildren(...told.childNodes);
  }, 100);

  // Sounds

  const CUES = {  // tones as [Hz, start s, length s]
    tick: [[660, 0, 0.07]],
    start: [[880, 0, 0.18]],
    success: [[660, 0, 0.1], [880, 0.1, 0.1], [1320, 0.2, 0.25]],
    kept: [[880, 0, 0.08], [1175, 0.1, 0.16]],
    discarded: [[440, 0, 0.1], [330, 0.12, 0.2]],
    error: [[220, 0, 0.3]],
  };
  let audio = null;  // made at a person's first click: browsers ask for that
  addEventListener("pointerdown", () => { audio ??= new AudioContext(); }, true);

  function play(cue) {
    if (!audio || !CUES[cue]) return;
    for (const [frequency, start, length] of CUES[cue]) {
      const from = audio.currentTime + start;
      const tone = audio.createOscillator();
      const volume = audio.createGain();
      tone.frequency.value = frequency;
      volume.gain.setValueAtTime(0.12, from);
      volume.gain.exponentialRampToValueAtTime(0.001, from + length);
      tone.connect(volume).connect(audio.destination);
      tone.start(from);
      tone.stop(from + length);
    }
  }

  let played = null;
  setInterval(() => {
    const sound = document.querySelector("[data-sound]")?.dataset.sound;
    if (sound === undefined || sound === played) return;
    if (played !== null) play(sound.split(" ")[1]);
    played = sound;
  }, 50);

  // Keys

  const pressed = new Map();  // code -> button

  function isTyping(target) {
    return target instanceof Element && target.closest("input, textarea, select, [contenteditable=true]") !== null;
  }

  function buttonOf(code) {
    for (const mark of document.querySelectorAll("[data-hold]")) {
      const index = mark.dataset.hold.split(" ").indexOf(code);
      let element = mark.parentElement;
      for (let step = 0; index >= 0 && step <= index; step++) element = element?.nextElementSibling;
      if (index >= 0) return element?.querySelector("button:not(:disabled)");
    }
  }

  function point(button, type) {
    button.dispatchEvent(new PointerEvent(type, { bubbles: true, button: 0, pointerId: 1, isPrimary: true }));
  }

  function release(code) {
    const button = pressed.get(code);
    if (button) point(button, "pointerup");
    pressed.delete(code);
  }

  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || isTyping(event.target)) return;
    const button = buttonOf(event.code);
    if (!button) return;
    event.stopImmediatePropagation();  // viser moves its camera by the same keys
    event.preventDefault();
    if (pressed.has(event.code)) return;
    pressed.set(event.code, button);
    point(button, "pointerdown");
  }, true);
  addEventListener("keyup", (event) => release(event.code), true);
  addEventListener("blur", () => [...pressed.keys()].forEach(release));

  // A clicked button keeps no focus: the space bar would press it again.
  addEventListener("click", (event) => {
    if (event.detail > 0) event.target.closest?.("button")?.blur();
  }, true);
})();
