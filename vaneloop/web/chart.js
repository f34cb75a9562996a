// Stacked time curves over one axis, drawn by uPlot. The server thins each view to what the screen can show (charts.py);
// a third of a view more is fetched to either side, so that panning has something to show before the answer is there.
import uPlot from "uplot";

const PAD = 0.34;

export default {
  template: `<div class="curves"><div ref="legend" class="curves-legend"></div><div ref="stack"></div>
    <div v-if="!live" ref="hint" class="curves-hint" style="display:none">drag: zoom &middot; wheel: zoom at the pointer &middot; shift + drag: pan &middot; double-click: everything</div></div>`,
  props: { src: String, version: Number, live: Number, unit: String },
  mounted() {
    this.plots = [];
    this.view = null; // [from, to] in s; null: everything
    this.shape = "";
    this.busy = false;
    this.again = false;
    this.hidden = {};
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(this.$el);
    this.themes = new MutationObserver(() => this.rebuild());
    this.themes.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    this.fetch();
    if (this.live) this.beat();
  },
  unmounted() {
    this.gone = true;
    clearTimeout(this.timer);
    this.sizes.disconnect();
    this.themes.disconnect();
    this.plots.forEach((p) => p.destroy());
  },
  watch: {
    version() { this.fetch(); },
    src() { this.view = null; this.fetch(); },
  },
  methods: {
    async beat() {
      // a slow machine is asked less often: a quarter of its time goes into drawing, down to one answer a second
      const began = performance.now();
      if (!document.hidden) await this.fetch();
      const drawn = await new Promise((done) => requestAnimationFrame(() => done(performance.now())));
      if (!this.gone) this.timer = setTimeout(() => this.beat(), Math.min(1000, Math.max(1000 / this.live, 3 * (drawn - began))));
    },
    width() { return Math.max(280, this.$el.clientWidth); },
    async fetch() {
      // one question at a time, the latest view wins
      if (this.busy) { this.again = true; return; }
      this.busy = true;
      try {
        const query = new URLSearchParams({ n: Math.round(this.width()) });
        if (this.view) {
          const more = (this.view[1] - this.view[0]) * PAD;
          query.set("from", this.view[0] - more);
          query.set("to", this.view[1] + more);
        }
        const answer = await fetch(this.src + "?" + query, { credentials: "same-origin" });
        if (answer.ok) this.take(await answer.arrayBuffer());
      } catch (e) { /* the server is away; the page says so itself */ } finally {
        this.busy = false;
        if (this.again) { this.again = false; this.fetch(); }
      }
    },
    take(buffer) {
      const size = new DataView(buffer).getUint32(0, true);
      const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
      let at = Math.ceil((4 + size) / 8) * 8;
      const next = (n) => { const a = new Float64Array(buffer, at, n); at += 8 * n; return a; };
      const data = head.panels.map((p) => [next(p.n), ...p.lines.map(() => Array.from(next(p.n), (v) => (v === v ? v : null)))]);
      this.head = head;
      this.data = data;
      const shape = JSON.stringify([head.panels.map((p) => [p.title, p.unit, p.lines, p.height]), head.key]);
      if (shape !== this.shape) {
        if (head.key !== this.key) this.view = null;
        this.key = head.key;
        this.shape = shape;
        this.build();
      } else {
        this.plots.forEach((p, i) => p.setData(data[i], false));
        this.scale();
      }
      this.$el.dataset.points = data.reduce((n, d) => n + d[0].length, 0);
      this.$el.dataset.answers = 1 + Number(this.$el.dataset.answers || 0);
    },
    scale() {
      // x: the view; y: what is seen of it
      const [a, b] = this.view || this.head.span;
      this.setting = true;
      this.plots.forEach((p) => p.batch(() => p.setScale("x", { min: a, max: b })));
      this.setting = false;
      this.$el.dataset.view = a.toFixed(4) + " " + b.toFixed(4);
    },
    look(a, b) {
      const [low, high] = this.head.span;
      const least = (high - low) * 1e-6;
      if (b - a < least) return;
      if (b - a >= high - low) this.view = null;
      else {
        if (a < low) { b += low - a; a = low; }
        if (b > high) { a -= b - high; b = high; }
        this.view = [a, b];
      }
      this.scale();
      this.fetch();
    },
    colours() {
      const css = getComputedStyle(document.body);
      return (role) => css.getPropertyValue("--" + role).trim() || "#888";
    },
    rebuild() { if (this.head && this.dark !== document.body.classList.contains("body--dark")) this.build(); },
    build() {
      this.dark = document.body.classList.contains("body--dark");
      if (this.$refs.hint) this.$refs.hint.style.display = this.head.panels.length ? "" : "none";
      this.plots.forEach((p) => p.destroy());
      this.$refs.stack.replaceChildren();
      const colour = this.colours();
      const legend = new Map();
      const first = this.head.panels.map((p) => p.lines.map((l) => l.name).join());
      const own = this.live && new Set(first).size > 1; // panels of other lines: each tells its own
      this.plots = this.head.panels.map((panel, i) => {
        if (!own) panel.lines.forEach((l) => legend.set(l.name, l.role));
        const last = i === this.head.panels.length - 1;
        const axis = { stroke: colour("soft"), grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid"), width: 1 }, font: "12px system-ui, sans-serif" };
        const plot = new uPlot({
          width: this.width(), height: panel.height + (last ? 34 : 12), padding: [8, 14, 0, 0],
          legend: { show: false },
          cursor: { sync: { key: this.src }, drag: { x: true, y: false, setScale: false }, focus: { prox: 24 }, points: { size: 6 } },
          scales: { x: { time: false }, y: { range: (u, low, high) => this.range(low, high, panel) } },
          axes: [
            { ...axis, show: last, size: last ? 34 : 0, values: (u, v) => v.map((x) => +x.toPrecision(9) + (x === v[v.length - 1] ? " s" : "")) },
            { ...axis, size: 62, label: panel.title, labelSize: 20, labelFont: "12px system-ui, sans-serif", labelGap: 0, values: (u, v) => v.map((x) => +x.toPrecision(6)) },
          ],
          series: [{}, ...panel.lines.map((l) => ({ label: l.name, stroke: colour(l.role), width: l.width || 1.25, dash: l.dash, points: { show: false }, show: !this.hidden[l.name] }))],
          hooks: {
            drawClear: [(u) => this.band(u, panel, colour)],
            setSelect: [(u) => {
              if (u.select.width > 4) {
                const a = u.posToVal(u.select.left, "x"), b = u.posToVal(u.select.left + u.select.width, "x");
                u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
                this.look(a, b);
              }
            }],
            setCursor: [(u) => this.read(u, i)],
          },
        }, this.data[i], this.$refs.stack);
        const readout = document.createElement("div");
        readout.className = "curves-readout";
        plot.root.appendChild(readout);
        plot.readout = readout;
        this.handle(plot);
        if (own && panel.lines.length > 1) {
          const names = document.createElement("div");
          names.className = "curves-own";
          panel.lines.forEach((l) => {
            const s = document.createElement("span");
            s.style.color = colour(l.role);
            s.textContent = l.name;
            names.append(s);
          });
          plot.root.appendChild(names);
        }
        return plot;
      });
      const names = [...legend].map(([name, role]) => {
        const b = document.createElement("button");
        b.type = "button";
        b.className = "curves-name" + (this.hidden[name] ? " off" : "");
        b.title = "show or hide";
        const mark = document.createElement("i");
        mark.style.background = colour(role);
        b.append(mark, document.createTextNode(name));
        b.onclick = () => { this.hidden[name] = !this.hidden[name]; this.build(); };
        return b;
      });
      this.$refs.legend.replaceChildren(...(legend.size > 1 ? names : []));
      this.scale();
    },
    range(low, high, panel) {
      if (low === null || !isFinite(low)) return [-1, 1];
      if (panel.band) { low = Math.min(low, -1.1 * panel.band); high = Math.max(high, 1.1 * panel.band); }
      if (high - low < panel.least) { const m = (low + high) / 2; low = m - panel.least / 2; high = m + panel.least / 2; }
      const more = 0.06 * (high - low) || Math.abs(high) * 0.01 || 1;
      return [low - more, high + more];
    },
    band(u, panel, colour) {
      if (!panel.band) return;
      const { left, top, width, height } = u.bbox;
      const y = (v) => Math.min(top + height, Math.max(top, u.valToPos(v, "y", true)));
      const c = u.ctx, a = y(panel.band), b = y(-panel.band);
      c.save();
      c.globalAlpha = 0.2;
      c.fillStyle = colour("noise");
      c.fillRect(left, a, width, b - a);
      c.restore();
    },
    read(u, i) {
      const k = u.cursor.idx, panel = this.head.panels[i];
      if (!u.readout) return;
      if (k === null || k === undefined || u.cursor.left < 0) { u.readout.textContent = ""; return; }
      const text = panel.lines.map((l, j) => { const v = u.data[j + 1][k]; return v === null || v === undefined ? "" : (panel.lines.length > 1 ? l.name + " " : "") + Number(v).toPrecision(5); });
      u.readout.textContent = Number(u.data[0][k]).toFixed(3) + " s  " + text.filter((x) => x).join("   ") + " " + panel.unit;
    },
    handle(plot) {
      const over = plot.over;
      over.addEventListener("wheel", (e) => {
        if (this.live) return;
        e.preventDefault();
        const [a, b] = this.view || this.head.span;
        const x = plot.posToVal(e.offsetX, "x"), f = Math.pow(1.0015, Math.max(-300, Math.min(300, e.deltaY)));
        if (Math.abs(e.deltaX) > Math.abs(e.deltaY)) { const d = (e.deltaX / over.clientWidth) * (b - a); this.look(a + d, b + d); }
        else this.look(x - (x - a) * f, x + (b - x) * f);
      }, { passive: false });
      over.addEventListener("mousedown", (e) => {
        if (!(e.shiftKey || e.button === 1) || !this.view) return;
        e.preventDefault();
        e.stopImmediatePropagation();
        const start = e.clientX, [a, b] = this.view;
        const move = (m) => { const d = ((start - m.clientX) / over.clientWidth) * (b - a); this.look(a + d, b + d); };
        const up = () => { document.removeEventListener("mousemove", move); document.removeEventListener("mouseup", up); };
        document.addEventListener("mousemove", move);
        document.addEventListener("mouseup", up);
      }, true);
      over.addEventListener("dblclick", () => { this.view = null; this.scale(); this.fetch(); });
    },
    resize() {
      const w = this.width();
      if (w === this.wide) return;
      this.wide = w;
      this.plots.forEach((p) => p.setSize({ width: w, height: p.height }));
    },
  },
};
