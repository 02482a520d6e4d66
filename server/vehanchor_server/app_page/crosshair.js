// ---- Crosshair: the pointer of the keyboard, over the picture ----

const STEP_PX = 10; // screen pixels; 1 with Shift
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function crosshair(view, size, moved) {
  const mark = html("div", { class: "crosshair", hidden: true, "aria-hidden": "true" });
  view.frame.append(mark);
  const cross = { at: size.map((side) => side / 2) };
  cross.place = () => {
    const [left, top] = view.inFrame(cross.at);
    Object.assign(mark.style, { left: `${left}px`, top: `${top}px` });
  };
  const centre = view.anchor;
  view.anchor = () => (mark.hidden ? centre() : view.inFrame(cross.at));
  cross.show = () => {
    mark.hidden = false;
    cross.goTo(cross.at);
  };
  cross.hide = () => { mark.hidden = true; };
  // Go to a place, and move the picture if the place is out of view.
  cross.goTo = (point) => {
    cross.at = point.map((value, i) => clamp(value, 0, size[i]));
    const [x, y] = view.inFrame(cross.at);
    view.move(clamp(x, 0, view.frame.clientWidth) - x, clamp(y, 0, view.frame.clientHeight) - y);
    cross.place();
  };
  view.frame.addEventListener("keydown", (event) => {
    const arrow = ARROWS[event.key];
    if (!view.picking || !arrow) return;
    event.preventDefault();
    const step = (event.shiftKey ? 1 : STEP_PX) / view.perPixel;
    mark.hidden = false;
    cross.goTo(cross.at.map((value, i) => value + arrow[i] * step));
    moved(cross.at);
  });
  view.frame.addEventListener("pointermove", ({ movementX, movementY }) => (movementX || movementY) && cross.hide());
  return cross;
}
