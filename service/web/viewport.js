// Zoom and pan of a drawing: wheel, pinch, drag, keyboard. A view maps a point (x, y) of the drawing to
// (k x + dx, k y + dy) in pixels of the window.

const MOST = 8; // Largest magnification.
const DRAG = 5; // Least movement of a drag, px; less is a click.
const STEP = 1.35; // Factor of a button or a key.
const SLIDE = 60; // Pan by a key, px.
const RATE = 0.0016; // Zoom by the wheel, per px.

export class Viewport {
  constructor(box, onChange) {
    this.box = box;
    this.onChange = onChange;
    this.world = this.size = { width: 1, height: 1 };
    Object.assign(this, { k: 1, dx: 0, dy: 0, least: 0.1, manual: false });
    this.pointers = new Map();
    this.dragged = false;
    box.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    box.addEventListener("pointerdown", (event) => this.down(event));
    box.addEventListener("pointermove", (event) => this.move(event));
    // Two fingers never scroll the page.
    box.addEventListener("touchmove", (event) => { if (event.touches.length > 1) event.preventDefault(); }, { passive: false });
    for (const name of ["pointerup", "pointercancel"]) box.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    // The click at the end of a drag selects nothing.
    box.addEventListener("click", (event) => { if (this.dragged) event.stopPropagation(); this.dragged = false; }, true);
    box.addEventListener("keydown", (event) => this.key(event));
  }

  // Take the sizes of a drawing and of its window, px.
  open(world, size) {
    Object.assign(this, { world, size });
    this.least = Math.min(1, size.width / world.width, size.height / world.height);
  }

  // Show a rectangle of the drawing, magnified at most to its natural size.
  fit({ x, y, width, height }, most = 1) {
    const k = Math.min(most, this.size.width / Math.max(width, 1), this.size.height / Math.max(height, 1));
    this.manual = false;
    this.set(k, this.size.width / 2 - k * (x + width / 2), this.size.height / 2 - k * (y + height / 2));
  }

  set(k, dx, dy) {
    this.k = Math.min(MOST, Math.max(this.least, k));
    // The drawing does not leave its window; a smaller one stays in the middle.
    const held = (d, size, world) => (world * this.k <= size ? (size - world * this.k) / 2 : Math.min(0, Math.max(size - world * this.k, d)));
    this.dx = held(dx, this.size.width, this.world.width);
    this.dy = held(dy, this.size.height, this.world.height);
    this.onChange();
  }

  // Magnify around a point of the window.
  zoom(factor, x = this.size.width / 2, y = this.size.height / 2) {
    const k = Math.min(MOST, Math.max(this.least, this.k * factor));
    if (k === this.k) return false;
    this.manual = true;
    this.set(k, x - ((x - this.dx) * k) / this.k, y - ((y - this.dy) * k) / this.k);
    return true;
  }

  pan(x, y) {
    const before = [this.dx, this.dy];
    this.set(this.k, this.dx + x, this.dy + y);
    if (before[0] === this.dx && before[1] === this.dy) return false;
    this.manual = true;
    return true;
  }

  step(direction) {
    return this.zoom(direction > 0 ? STEP : 1 / STEP);
  }

  // Place of a point of the drawing in the window, px.
  at({ x, y }) {
    return { x: this.k * x + this.dx, y: this.k * y + this.dy };
  }

  holds(point, margin = 0) {
    const { x, y } = this.at(point);
    return x >= margin && y >= margin && x <= this.size.width - margin && y <= this.size.height - margin;
  }

  // Bring a point of the drawing into the window.
  reveal(point, margin = 40) {
    if (this.holds(point, margin)) return;
    const { x, y } = this.at(point);
    this.set(this.k, this.dx + this.size.width / 2 - x, this.dy + this.size.height / 2 - y);
  }

  // At the ends of the zoom the wheel scrolls the page.
  wheel(event) {
    const edge = this.box.getBoundingClientRect();
    const lines = event.deltaMode === 1 ? 20 : 1;
    const speed = event.ctrlKey ? 6 : 1; // A touchpad's pinch.
    if (this.zoom(Math.exp(-RATE * speed * lines * event.deltaY), event.clientX - edge.left, event.clientY - edge.top) || event.ctrlKey) event.preventDefault();
  }

  down(event) {
    if (event.button !== 0) return;
    if (!this.pointers.size) this.dragged = false;
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, x0: event.clientX, y0: event.clientY });
  }

  move(event) {
    const old = this.pointers.get(event.pointerId);
    if (!old) return;
    if (event.pointerType === "mouse" && !event.buttons) {
      this.pointers.delete(event.pointerId);
      return;
    }
    const now = { ...old, x: event.clientX, y: event.clientY };
    this.pointers.set(event.pointerId, now);
    if (this.pointers.size === 2) {
      const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
      const edge = this.box.getBoundingClientRect();
      const [was, is] = [old, now].map((point) => Math.hypot(point.x - other.x, point.y - other.y));
      this.dragged = true;
      this.pan((now.x - old.x) / 2, (now.y - old.y) / 2);
      if (was > 0) this.zoom(is / was, (now.x + other.x) / 2 - edge.left, (now.y + other.y) / 2 - edge.top);
    } else if (this.pointers.size === 1) {
      if (!this.dragged && Math.hypot(now.x - now.x0, now.y - now.y0) < DRAG) return;
      if (!this.dragged) this.box.setPointerCapture(event.pointerId);
      this.dragged = true;
      this.pan(now.x - old.x, now.y - old.y);
    }
  }

  key(event) {
    const slide = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const zoom = { "+": 1, "=": 1, "-": -1, _: -1 }[event.key];
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    if (zoom) this.step(zoom);
    else if (slide && event.shiftKey) this.pan(SLIDE * slide[0], SLIDE * slide[1]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}
