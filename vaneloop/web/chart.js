// Stacked time curves over one axis, drawn by uPlot. The server thins each view to what the screen can show (charts.py);
// a third of a view more is fetched to either side, so that panning has something to show before the answer is there.
import uPlot from "uplot";

const PAD = 0.34;
const ROWS = 4; // of names of marks and bands

export default {
  template: `<div class="curves"><div v-if="tools" class="curves-tools">
      <input v-if="tree" v-model="word" @input="build" class="curves-find" type="search" placeholder="find a channel" aria-label="find a channel">
      <button v-for="(act, name) in { PNG: png, SVG: svg, CSV: csv }" :key="name" type="button" class="curves-tool" @click="act" :aria-label="'save these curves as ' + name">{{ name }}</button>
      <template v-if="tree"><input v-model="name" class="curves-find" placeholder="name of a layout" aria-label="name of a layout" @keydown.enter="keep">
      <button type="button" class="curves-tool" @click="keep" aria-label="keep this layout: view, channels, lines hidden, reference">Keep layout</button>
      <select v-if="Object.keys(kept).length" class="curves-tool" aria-label="show a layout that was kept" @change="recall($event.target.value)">
        <option value="" :selected="!shown">layouts kept</option><option v-for="(_, n) in kept" :key="n" :value="n" :selected="n === shown">{{ n }}</option></select>
      <button v-if="kept[name]" type="button" class="curves-tool" @click="forget" :aria-label="'forget the layout ' + name">Forget</button>
      <label v-for="k in 2" :key="k" class="curves-cursor">cursor {{ k }} [s] <input class="curves-find" inputmode="decimal" v-model="typed[k - 1]" @change="type_(k)" @keydown.enter="type_(k)"></label>
      <span v-if="apart" class="curves-apart">{{ apart }}</span></template></div>
    <div v-if="wrong" class="complaint" role="alert">{{ wrong }}</div>
    <details v-if="tools && tree" class="curves-tree"><summary>Channels: {{ names.filter((c) => wanted(c)).length }} of {{ names.length }} shown</summary>
      <div class="curves-groups"><fieldset v-for="group in groups()" :key="group.name"><legend><label><input type="checkbox" :checked="group.list.every((c) => !off[c.title])"
        @change="show(group.list, $event.target.checked)"> {{ group.name }}</label></legend>
        <label v-for="c in group.list" :key="c.title"><input type="checkbox" :checked="!off[c.title]" @change="show([c], $event.target.checked)"> {{ c.title }}</label></fieldset></div></details>
    <div ref="legend" class="curves-legend"></div>
    <div ref="stack" class="curves-stack" :tabindex="tools ? 0 : undefined" role="group" :aria-label="!tools ? 'curves' : 'curves; arrow keys move the cursor, plus and minus zoom, page keys pan, home shows everything, enter sets the reference' + (tree ? ', shift and enter cursor 2' : '')" @keydown="key_"></div>
    <div ref="said" class="away" role="status"></div>
    <div v-if="!live" ref="hint" class="curves-hint" style="display:none">drag: zoom &middot; wheel: zoom at the pointer &middot; shift + drag: pan &middot; click: reference for differences<template v-if="tree"> (cursor 1) &middot; alt + click: cursor 2</template> &middot; double-click: everything</div></div>`,
  props: { src: String, version: Number, live: Number, unit: String, tree: Boolean, cursors: Array },
  data() { return { tools: false, word: "", name: "", shown: "", names: [], off: {}, kept: {}, typed: ["", ""], apart: "", wrong: "" }; },
  mounted() {
    this.plots = [];
    this.view = null; // [from, to] in s; null: everything
    this.shape = "";
    this.busy = false;
    this.again = false;
    this.hidden = {};
    this.known = [null, null];
    [this.at, this.to] = this.cursors || [null, null]; // s: cursor 1, the reference, and cursor 2
    this.kept = JSON.parse(localStorage.getItem("layouts " + this.src) || "{}");
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
      this.tools = !this.live && head.panels.length > 0;
      const names = head.panels.map((p) => ({ title: p.title, group: p.group }));
      if (JSON.stringify(names) !== JSON.stringify(this.names)) this.names = names;
      const shape = JSON.stringify([head.panels.map((p) => [p.title, p.unit, p.lines, p.height]), head.key]);
      if (shape !== this.shape) {
        if (head.key !== this.key && this.key !== undefined) { this.view = null; this.at = this.to = null; }
        this.key = head.key;
        this.shape = shape;
        this.build();
        this.told(false);
      } else {
        this.plots.forEach((p) => p.setData(data[p.panel], false));
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
      this.shown = "";
      this.scale();
      this.fetch();
    },
    everything() {
      this.shown = "";
      this.view = null;
      this.scale();
      this.fetch();
    },
    colours() {
      const css = getComputedStyle(document.body);
      return (role) => css.getPropertyValue("--" + role).trim() || "#888";
    },
    rebuild() { if (this.head && this.dark !== document.body.classList.contains("body--dark")) this.build(); },
    wanted(channel) {
      const word = this.word.trim().toLowerCase();
      return !this.off[channel.title] && (!word || channel.title.toLowerCase().includes(word));
    },
    groups() {
      const word = this.word.trim().toLowerCase(), out = new Map();
      this.names.filter((c) => !word || c.title.toLowerCase().includes(word)).forEach((c) => out.set(c.group, [...(out.get(c.group) || []), c]));
      return [...out].map(([name, list]) => ({ name: name || "other", list }));
    },
    show(list, on) {
      this.shown = "";
      list.forEach((c) => { this.off[c.title] = !on; });
      this.build();
    },
    build() {
      this.wide = this.width();
      this.dark = document.body.classList.contains("body--dark");
      if (this.$refs.hint) this.$refs.hint.style.display = this.head.panels.length ? "" : "none";
      this.plots.forEach((p) => p.destroy());
      this.$refs.stack.replaceChildren();
      const colour = this.colours();
      const legend = new Map();
      const first = this.head.panels.map((p) => p.lines.map((l) => l.name).join());
      const own = this.live && new Set(first).size > 1; // panels of other lines: each tells its own, above them
      this.own = own;
      const shown = this.head.panels.map((p, i) => i).filter((i) => this.wanted(this.head.panels[i]));
      const several = !own && this.head.panels.some((p) => p.lines.length > 1); // where each has one, its title names it
      this.plots = shown.map((i) => {
        const panel = this.head.panels[i];
        if (several) panel.lines.forEach((l) => legend.set(l.name, l));
        const last = i === shown[shown.length - 1];
        const axis = { stroke: colour("soft"), grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid"), width: 1 }, font: "12px system-ui, sans-serif" };
        const plot = new uPlot({
          width: this.wide, height: panel.height + (last ? 34 : 12), padding: [8, 14, 0, 0],
          legend: { show: false },
          cursor: { sync: { key: "vaneloop", scales: ["x", null] }, drag: { x: true, y: false, setScale: false }, focus: { prox: 24 }, points: { size: 6 } },
          scales: { x: { time: false }, y: { range: (u, low, high) => this.range(low, high, panel) } },
          axes: [
            { ...axis, show: last, size: last ? 34 : 0, values: (u, v) => v.map((x) => +x.toPrecision(9) + (x === v[v.length - 1] ? " s" : "")) },
            { ...axis, size: 62, label: panel.title, labelSize: 20, labelFont: "12px system-ui, sans-serif", labelGap: 0, values: (u, v) => v.map((x) => +x.toPrecision(6)) },
          ],
          series: [{}, ...panel.lines.map((l) => ({ label: l.name, stroke: colour(l.role), width: l.width || 1.25, dash: l.dash && l.dash.length ? l.dash : undefined, points: { show: false }, show: !this.hidden[l.name] }))],
          hooks: {
            drawClear: [(u) => this.band(u, panel, colour), (u) => this.spans(u, colour)],
            draw: [(u) => this.marks(u, colour, i === shown[0])],
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
        plot.panel = i;
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
      this.legend = legend.size > 1 ? [...legend] : [];
      const names = [...legend].map(([name, l]) => {
        const b = document.createElement("button");
        b.type = "button";
        b.className = "curves-name" + (this.hidden[name] ? " off" : "");
        b.title = "show or hide";
        const mark = document.createElement("i");
        mark.style.borderTopColor = colour(l.role);
        if (l.dash && l.dash.length) mark.style.borderTopStyle = "dashed";
        b.append(mark, document.createTextNode(name));
        b.onclick = () => { this.shown = ""; this.hidden[name] = !this.hidden[name]; this.build(); };
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
      const above = this.own && panel.lines.length > 1 ? 20 / Math.max(60, panel.height - 8) : 0; // names lie over no line
      return [low - more, high + more + (high - low + 2 * more) * above / (1 - above)];
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
    spans(u, colour) {
      const { left, top, width, height } = u.bbox, c = u.ctx;
      (this.head.bands || []).forEach(([a, b, text, role]) => {
        const x = Math.max(left, u.valToPos(a, "x", true)), y = Math.min(left + width, u.valToPos(b, "x", true));
        if (y <= left || x >= left + width) return;
        c.save();
        c.globalAlpha = 0.16;
        c.fillStyle = colour(role);
        c.fillRect(x, top, Math.max(1, y - x), height);
        c.restore();
      });
    },
    marks(u, colour, named) {
      const { left, top, width, height } = u.bbox, c = u.ctx, dots = devicePixelRatio || 1, right = left + width;
      const inside = (x) => x >= left && x <= right;
      const line = (x, role) => {
        c.strokeStyle = colour(role);
        c.setLineDash([4 * dots, 3 * dots]);
        c.lineWidth = dots;
        c.beginPath(); c.moveTo(x, top); c.lineTo(x, top + height); c.stroke();
      };
      c.save();
      const marks = (this.head.marks || []).map(([t, text]) => ({ x: u.valToPos(t, "x", true), text, role: "bad" })).filter((m) => inside(m.x));
      marks.forEach((m) => line(m.x, m.role));
      const cursors = [this.at, this.to].map((t, k) => ({ t, text: this.tree ? String(k + 1) : "", role: "text" })).filter((m) => m.t !== null).map((m) => ({ ...m, x: u.valToPos(m.t, "x", true) }));
      cursors.filter((m) => inside(m.x)).forEach((m) => line(m.x, m.role));
      if (cursors.length === 2) {
        const [a, b] = cursors.map((m) => Math.min(right, Math.max(left, m.x))).sort((m, n) => m - n);
        c.globalAlpha = 0.07; c.fillStyle = colour("text"); c.fillRect(a, top, b - a, height); c.globalAlpha = 1;
      }
      if (named) {
        c.font = 11 * dots + "px system-ui, sans-serif";
        c.textAlign = "left";
        c.textBaseline = "alphabetic";
        const bands = (this.head.bands || []).map(([a, b, text]) => ({ x: Math.max(left, u.valToPos(a, "x", true)), end: u.valToPos(b, "x", true), text, role: "text" })).filter((m) => m.end > left && m.x < right);
        const words = (list) => this.placed(list, left, right, (t) => c.measureText(t).width, 4 * dots);
        const above = words([...marks, ...cursors.filter((m) => m.text && inside(m.x))]), below = words(bands), rows = 12 * dots, head = this.own ? 16 * dots : 0;
        const write = (m, y) => { // legible where a line passes
          c.globalAlpha = 0.75;
          c.fillStyle = colour("panel");
          c.fillRect(m.from - dots, y - 10 * dots, m.to - m.from + 2 * dots, rows);
          c.globalAlpha = 1;
          c.fillStyle = colour(m.role);
          c.fillText(m.text, m.from, y);
        };
        above.forEach((m) => write(m, top + head + rows * (m.row + 1)));
        below.forEach((m) => write(m, top + height - 4 * dots - rows * m.row));
        this.$el.dataset.labels = JSON.stringify([above, below].map((l) => l.map((m) => [m.from, m.to, m.row, m.text])));
      }
      c.restore();
    },
    // Words beside their x, none over another: the next row where the one before is taken, up to ROWS; then left out.
    placed(list, left, right, wide, gap) {
      const ends = Array(ROWS).fill(-Infinity), last = Array(ROWS).fill("");
      return [...list].sort((a, b) => a.x - b.x).flatMap((m) => {
        const w = wide(m.text), from = Math.max(left + gap, Math.min(m.x + gap, right - w - gap));
        if (last.some((t, i) => t === m.text && from < ends[i])) return []; // the same word is there already
        const row = ends.findIndex((end) => end + gap < from);
        if (row < 0) return [];
        ends[row] = from + w;
        last[row] = m.text;
        return [{ ...m, from, to: from + w, row }];
      });
    },
    moment(t) {
      // show a moment of a log with what is near it to each side; a live chart is held by the server
      this.at = t;
      this.told();
      const near = this.head?.near ?? 2;
      if (!this.live) this.look(t - near, t + near);
      this.plots.forEach((p) => p.redraw(false));
      if (t !== null) this.$el.scrollIntoView({ behavior: "smooth", block: this.live ? "nearest" : "center" });
    },
    key_(e) {
      if (!this.head || !this.head.panels.length || !this.plots.length) return;
      const [a, b] = this.view || this.head.span, w = b - a, u = this.plots[0];
      const at = u.cursor.left >= 0 && u.cursor.left !== undefined && u.cursor.left !== null ? u.posToVal(u.cursor.left, "x") : (a + b) / 2;
      const step = (e.shiftKey ? 0.1 : 0.01) * w;
      const cursor = (t) => { u.setCursor({ left: u.valToPos(Math.min(b, Math.max(a, t)), "x"), top: 10 }, true, true); this.$refs.said.textContent = this.plots.map((p) => this.head.panels[p.panel].title + " " + p.readout.textContent).join("; "); };
      const acts = { ArrowLeft: () => cursor(at - step), ArrowRight: () => cursor(at + step), "+": () => this.look(at - w / 4, at + w / 4), "-": () => this.look(at - w, at + w),
        PageUp: () => this.look(a - w / 2, b - w / 2), PageDown: () => this.look(a + w / 2, b + w / 2), Home: () => this.everything(), Enter: () => this.refer(at, this.tree && e.shiftKey) };
      if (!acts[e.key] || this.live) return;
      e.preventDefault();
      acts[e.key]();
    },
    refer(t, second) {
      // set cursor 1, the reference, or cursor 2; where it stands already, it goes
      const which = second ? "to" : "at";
      this.shown = "";
      this[which] = this[which] !== null && t !== null && Math.abs(this[which] - t) < 1e-9 ? null : t;
      this.told();
      this.plots.forEach((p) => p.redraw(false));
    },
    told(out = true) {
      // say where the cursors are: in the fields, and to the server
      const said = (t) => (t === null ? "" : String(+t.toFixed(6)));
      [this.at, this.to].forEach((t, k) => { // what is being typed stays, unless the cursor has moved
        if (t !== this.known[k]) { this.known[k] = t; this.typed[k] = said(t); }
      });
      this.apart = this.at === null || this.to === null ? "" : `${+Math.abs(this.to - this.at).toPrecision(6)} s apart`;
      this.wrong = "";
      const now = JSON.stringify([this.at, this.to]);
      if (out && this.tree && now !== this.sent) this.$emit("cursors", [this.at, this.to]);
      this.sent = now;
    },
    type_(k) {
      const typed = this.typed[k - 1].trim(), text = typed.replace(",", "."), t = Number(text), [low, high] = this.head.span, before = k === 1 ? this.at : this.to;
      if (text && !(t >= low && t <= high)) {
        this.wrong = `cursor ${k} (=${typed}) must be a time of the log, ${+low.toPrecision(9)} to ${+high.toPrecision(9)} s`;
        return;
      }
      const next = text ? t : null;
      if (next !== before) this.refer(next, k === 2);
      else this.told(false);
      const [a, b] = this.view || this.head.span;
      if (next !== null && (next < a || next > b)) this.look(next - (b - a) / 2, next + (b - a) / 2);
    },
    save(name, href) { const a = document.createElement("a"); a.href = href; a.download = name; a.click(); },
    file(suffix) { return this.src.split("/").pop() + "." + suffix; },
    csv() {
      const [a, b] = this.view || this.head.span, rows = ["channel,line,t,value"];
      // a spreadsheet runs text that begins like this as a formula; with an apostrophe in front it does not
      const marked = (v) => (/^'*[=+\-@\t\r]./s.test(v) ? "'" + v : v);
      const q = (v) => (/[",\r\n]/.test(v) ? '"' + marked(v).replace(/"/g, '""') + '"' : marked(v));
      this.plots.forEach((p) => this.head.panels[p.panel].lines.forEach((l, j) => p.data[0].forEach((t, k) => {
        const v = p.data[j + 1][k];
        if (!this.hidden[l.name] && t >= a && t <= b && v !== null && v !== undefined) rows.push([q(this.head.panels[p.panel].title), q(l.name), Number(t.toPrecision(12)), v].join(","));
      })));
      this.save(this.file("csv"), URL.createObjectURL(new Blob([rows.join("\n") + "\n"], { type: "text/csv" })));
    },
    png() {
      const all = this.plots.map((p) => p.ctx.canvas), out = document.createElement("canvas"), dots = devicePixelRatio || 1;
      const colour = this.colours(), head = this.legend.length ? 20 * dots : 0;
      out.width = Math.max(...all.map((c) => c.width));
      out.height = head + all.reduce((n, c) => n + c.height, 0);
      const c = out.getContext("2d");
      c.fillStyle = colour("panel");
      c.fillRect(0, 0, out.width, out.height);
      c.font = 12 * dots + "px system-ui, sans-serif";
      let x = 66 * dots, y = head;
      this.legend.forEach(([name, l]) => {
        c.strokeStyle = colour(l.role); c.lineWidth = 2 * dots; c.setLineDash((l.dash || []).map((d) => d * dots));
        c.beginPath(); c.moveTo(x, 11 * dots); c.lineTo(x + 20 * dots, 11 * dots); c.stroke();
        c.fillStyle = colour("text"); c.fillText(name, x + 25 * dots, 15 * dots);
        x += 45 * dots + c.measureText(name).width;
      });
      all.forEach((part) => { c.drawImage(part, 0, y); y += part.height; });
      this.save(this.file("png"), out.toDataURL("image/png"));
    },
    svg() {
      const colour = this.colours(), w = this.width(), e = (t) => String(t).replace(/[&<>]/g, (x) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[x]);
      const ruler = document.createElement("canvas").getContext("2d");
      ruler.font = "11px sans-serif";
      const wide = (t) => ruler.measureText(t).width;
      const stroke = (l) => `stroke="${colour(l.role)}"` + (l.dash && l.dash.length ? ` stroke-dasharray="${l.dash.join(" ")}"` : "");
      let x = 66, y = this.legend.length ? 20 : 0;
      const legend = this.legend.map(([name, l]) => {
        const at = x;
        x += 45 + wide(name);
        return `<path d="M${at} 11L${at + 20} 11" stroke-width="2" ${stroke(l)}/><text x="${at + 25}" y="15">${e(name)}</text>`;
      }).join("");
      const ticks = (p, scale) => { // where uPlot has drawn them, with its words
        const axis = p.axes.find((a) => a.scale === scale && a._splits) || this.plots.flatMap((o) => o.axes).find((a) => a.scale === scale && a._splits);
        return axis ? axis._splits.map((v, k) => [v, axis._values[k]]).filter(([v, text]) => text !== null && text !== "" && v >= p.scales[scale].min && v <= p.scales[scale].max) : [];
      };
      const parts = this.plots.map((p, first) => {
        const panel = this.head.panels[p.panel], h = p.height, dots = devicePixelRatio || 1, box = p.bbox, top = y;
        y += h;
        const x = (t) => p.valToPos(t, "x", true) / dots, X = (t) => x(t).toFixed(1), Y = (v) => (p.valToPos(v, "y", true) / dots + top).toFixed(1);
        const lines = panel.lines.map((l, j) => {
          if (this.hidden[l.name]) return "";
          let path = "", pen = "M";
          p.data[0].forEach((t, k) => { const v = p.data[j + 1][k]; if (v === null || v === undefined) { pen = "M"; return; } path += pen + X(t) + " " + Y(v); pen = "L"; });
          return `<path d="${path}" fill="none" stroke-width="${l.width || 1.25}" ${stroke(l)}/>`;
        }).join("");
        const [L, T, W, H] = [box.left, box.top, box.width, box.height].map((v) => v / dots);
        const spans = (this.head.bands || []).map(([a, b, , role]) => `<rect x="${X(a)}" y="${top + T}" width="${Math.max(1, x(b) - x(a)).toFixed(1)}" height="${H}" fill="${colour(role)}" fill-opacity="0.16"/>`).join("");
        const floor = panel.band ? `<rect x="${L}" y="${Y(panel.band)}" width="${W}" height="${(Y(-panel.band) - Y(panel.band)).toFixed(1)}" fill="${colour("noise")}" fill-opacity="0.2"/>` : "";
        const upright = [...(this.head.marks || []).map(([t]) => [t, "bad"]), ...[this.at, this.to].filter((t) => t !== null).map((t) => [t, "text"])]
          .map(([t, role]) => `<path d="M${X(t)} ${top + T}L${X(t)} ${top + T + H}" stroke="${colour(role)}" stroke-dasharray="4 3"/>`).join("");
        const named = first ? "" : [[(this.head.marks || []).map(([t, text]) => ({ x: x(t), end: x(t), text, role: "bad" })), (m) => top + T + 12 * (m.row + 2)],
          [(this.head.bands || []).map(([a, b, text]) => ({ x: Math.max(L, x(a)), end: x(b), text, role: "text" })), (m) => top + T + H - 4 - 12 * m.row]]
          .map(([list, at]) => this.placed(list.filter((m) => m.end >= L && m.x <= L + W), L, L + W, wide, 4).map((m) => `<text x="${m.from}" y="${at(m)}" fill="${colour(m.role)}">${e(m.text)}</text>`).join("")).join("");
        const grid = [...ticks(p, "y").map(([v]) => `M${L} ${Y(v)}h${W}`), ...ticks(p, "x").map(([t]) => `M${X(t)} ${top + T}v${H}`)].join("");
        const words = [...ticks(p, "y").map(([v, text]) => [L - 6, Number(Y(v)) + 4, "end", text]), [L + 4, top + T + 12, "start", panel.title]]
          .map(([x, at, anchor, text]) => `<text x="${x}" y="${at}" text-anchor="${anchor}">${e(text)}</text>`).join("");
        return `<clipPath id="c${p.panel}"><rect x="${L}" y="${top + T}" width="${W}" height="${H}"/></clipPath><rect x="${L}" y="${top + T}" width="${W}" height="${H}" fill="none" stroke="${colour("grid")}"/><path class="grid" d="${grid}" stroke="${colour("grid")}"/><g clip-path="url(#c${p.panel})">${spans}${floor}${lines}${upright}</g>${named}${words}`;
      }).join("");
      const last = this.plots[this.plots.length - 1];
      const foot = ticks(last, "x").map(([t, text]) => `<text x="${(last.valToPos(t, "x", true) / (devicePixelRatio || 1)).toFixed(1)}" y="${y + 14}" text-anchor="middle">${e(text)}</text>`).join("") + `<text x="${w - 4}" y="${y + 14}" text-anchor="end">s</text>`;
      const text = `<svg xmlns="http://www.w3.org/2000/svg" width="${w}" height="${y + 20}" font-family="sans-serif" font-size="11" fill="${colour("text")}"><rect width="100%" height="100%" fill="${colour("panel")}"/>${legend}${parts}${foot}</svg>`;
      this.save(this.file("svg"), URL.createObjectURL(new Blob([text], { type: "image/svg+xml" })));
    },
    store() {
      localStorage.setItem("layouts " + this.src, JSON.stringify(this.kept));
      this.kept = { ...this.kept };
    },
    keep() {
      for (let k = 1; !this.name.trim(); k += 1) if (!this.kept["layout " + k]) this.name = "layout " + k;
      this.name = this.name.trim();
      this.kept[this.name] = { view: this.view, word: this.word, hidden: { ...this.hidden }, off: { ...this.off }, at: this.at, to: this.to };
      this.shown = this.name;
      this.store();
    },
    forget() {
      delete this.kept[this.name];
      this.name = this.shown = "";
      this.store();
    },
    recall(name) {
      const kept = this.kept[name];
      if (!kept) return;
      this.name = this.shown = name;
      this.word = kept.word;
      this.hidden = { ...kept.hidden };
      this.off = { ...kept.off };
      this.view = kept.view;
      this.at = kept.at;
      this.to = kept.to ?? null;
      this.told();
      this.build();
      this.fetch();
    },
    read(u, i) {
      const k = u.cursor.idx, panel = this.head.panels[i];
      if (!u.readout) return;
      if (k === null || k === undefined || u.cursor.left < 0) { u.readout.textContent = ""; return; }
      const text = panel.lines.map((l, j) => { const v = u.data[j + 1][k]; return v === null || v === undefined ? "" : (panel.lines.length > 1 ? l.name + " " : "") + Number(v).toPrecision(5); });
      let apart = "";
      if (this.at !== null && u.data[0].length) {
        const r = u.valToIdx(this.at), d = panel.lines.map((l, j) => { const v = u.data[j + 1][k], w = u.data[j + 1][r]; return v === null || w === null || v === undefined || w === undefined ? "" : (v - w).toPrecision(4); });
        apart = "  | to the reference: " + (u.data[0][k] - this.at).toFixed(3) + " s, " + d.filter((x) => x).join(", ") + " " + panel.unit;
      }
      u.readout.textContent = Number(u.data[0][k]).toFixed(3) + " s  " + text.filter((x) => x).join("   ") + " " + panel.unit + apart;
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
      let down = 0;
      over.addEventListener("pointerdown", (e) => { down = e.clientX; });
      over.addEventListener("click", (e) => { if (!this.live && Math.abs(e.clientX - down) < 4 && e.detail === 1) this.refer(plot.posToVal(e.offsetX, "x"), this.tree && e.altKey); });
      over.addEventListener("dblclick", () => this.everything());
    },
    resize() {
      const w = this.width();
      if (w === this.wide) return;
      this.wide = w;
      this.plots.forEach((p) => p.setSize({ width: w, height: p.height }));
    },
  },
};
