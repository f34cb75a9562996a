// A Plotly figure that follows the width of its box, and nothing else: NiceGUI's own complains where a box is hidden or gone.
// Where a map's cells lead somewhere, arrow keys choose one, too, and enter is a click on it.
import { Plotly } from "nicegui-plotly";

export default {
  template: `<div><div ref="plot" :tabindex="map ? 0 : undefined" :role="map ? 'group' : undefined" @keydown="key_"
    :aria-label="map ? 'failure map: arrow keys choose a cell, enter shows its moment' : undefined"></div><div ref="said" class="away" role="status"></div></div>`,
  props: { options: Object },
  computed: { map() { return this.options.data.find((d) => d.type === "heatmap" && d.customdata); } },
  mounted() {
    this.plot = this.$refs.plot;
    this.lines = [...(this.options.layout.shapes || [])];  // Plotly writes into what it is given
    // a width that is set while a figure is being drawn is lost: one after the other
    this.drawn = Plotly.newPlot(this.plot, this.options.data, this.options.layout, this.options.config);
    this.plot.on("plotly_click", (e) => this.go(e.points[0].customdata));
    const fit = () => this.fit();
    this.sizes = new ResizeObserver(() => { this.drawn = this.drawn.then(fit, fit); }); // after one that failed, too
    this.sizes.observe(this.$el);
  },
  unmounted() { this.sizes.disconnect(); Plotly.purge(this.plot); },
  methods: {
    fit() {
      const w = this.$el.clientWidth;
      if (w <= 0 || w === this.wide || !this.$el.isConnected) return;
      return Plotly.relayout(this.plot, { width: w }).then(() => { this.wide = w; });
    },
    go(t) { if (typeof t === "number") this.$emit("cell", t); },
    key_(e) {
      const by = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 0], ArrowDown: [-1, 0] }[e.key], m = this.map;
      if (!m || (!by && e.key !== "Enter")) return;
      e.preventDefault();
      if (!by) { if (this.cell) this.go(m.customdata[this.cell[0]][this.cell[1]]); return; }
      const told = (i, j) => m.z[i] && typeof m.z[i][j] === "number";
      let [i, j] = this.cell ? [this.cell[0] + by[0], this.cell[1] + by[1]] : [m.z.length - 1, 0];
      while (m.z[i] && j >= 0 && j < m.z[i].length && !told(i, j)) { i += by[0]; j += by[1]; }  // over what was never visited
      if (!told(i, j)) return;
      this.cell = [i, j];
      const box = { type: "rect", x0: j - 0.5, x1: j + 0.5, y0: i - 0.5, y1: i + 0.5, line: { width: 3, color: getComputedStyle(this.$el).color } };
      Plotly.relayout(this.plot, { shapes: [...this.lines, box] });
      this.$refs.said.textContent = `${m.y[i]} ${m.hovertext ? m.hovertext[i][j] : m.x[j]}: ${m.z[i][j].toPrecision(3)} noise floors`;
      const at = this.plot.querySelector(".shapelayer path:last-child");
      if (at) at.scrollIntoView({ block: "nearest", inline: "nearest" });
    },
  },
};
