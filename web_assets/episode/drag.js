// Pointers that are held and moved.

// Until the pointer is let go, `move(event)`; then `end(event, hasMoved)`. Escape or a lost pointer calls `end(null)`.
export function drag(start, { move, end }) {
  const element = start.currentTarget;
  let hasMoved = false;
  start.preventDefault();
  start.stopPropagation();
  document.activeElement?.blur?.();
  element.setPointerCapture(start.pointerId);
  const onMove = (event) => {
    hasMoved ||= Math.abs(event.clientX - start.clientX) > 2;
    if (hasMoved) move(event);
  };
  const finish = (event) => {
    element.removeEventListener("pointermove", onMove);
    element.removeEventListener("pointerup", onUp);
    element.removeEventListener("pointercancel", onCancel);
    removeEventListener("keydown", onKey, true);
    end(event, hasMoved);
  };
  const onUp = (event) => finish(event);
  const onCancel = () => finish(null);
  const onKey = (event) => {
    if (event.key !== "Escape") return;
    event.stopPropagation();
    finish(null);
  };
  element.addEventListener("pointermove", onMove);
  element.addEventListener("pointerup", onUp);
  element.addEventListener("pointercancel", onCancel);
  addEventListener("keydown", onKey, true);
}

// The time on the axis that lies under a pointer, for an element as wide as the axis.
export function timeUnder(event, element, axis) {
  const { left, width } = element.getBoundingClientRect();
  return axis.from + ((event.clientX - left) / width) * (axis.to - axis.from);
}

// On `element`: drag or click moves the playhead, with Shift it marks what to zoom to, the middle button pans;
// the wheel zooms, with Shift it pans; a double click shows all.
export function navigates(element, axis, playhead) {
  element.addEventListener("pointerdown", (event) => {
    const at = (each) => timeUnder(each, element, axis);
    if (event.button === 1) {
      let before = event.clientX;
      drag(event, {
        move: (each) => {
          axis.pan((before - each.clientX) / element.clientWidth);
          before = each.clientX;
        },
        end: () => {},
      });
    } else if (event.button === 0 && event.shiftKey) {
      const from = at(event);
      const box = document.createElement("div");
      box.className = "zooming";
      element.append(box);
      const [left] = [event.clientX - element.getBoundingClientRect().left];
      drag(event, {
        move: (each) => {
          const width = each.clientX - event.clientX;
          Object.assign(box.style, { left: `${left + Math.min(width, 0)}px`, width: `${Math.abs(width)}px` });
        },
        end: (each, hasMoved) => {
          box.remove();
          if (each && hasMoved) axis.show(Math.min(from, at(each)), Math.max(from, at(each)));
        },
      });
    } else if (event.button === 0) {
      playhead.seek(at(event));
      drag(event, { move: (each) => playhead.seek(at(each)), end: () => {} });
    }
  });
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    const sideways = event.shiftKey ? event.deltaY || event.deltaX : event.deltaX;
    if (Math.abs(sideways) > Math.abs(event.shiftKey ? 0 : event.deltaY)) axis.pan(sideways / 800);
    else axis.zoom(Math.exp(event.deltaY / 500), timeUnder(event, element, axis));
  }, { passive: false });
  element.addEventListener("dblclick", () => axis.showAll());
}

// Over a share of what it lies in.
export function place(element, left, width) {
  element.style.left = `${100 * left}%`;
  element.style.width = `${100 * width}%`;
}
