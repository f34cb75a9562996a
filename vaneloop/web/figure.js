// A Plotly figure that follows the width of its box, and nothing else: NiceGUI's own complains where a box is hidden or gone.
import { Plotly } from "nicegui-plotly";

export default {
  template: "<div></div>",
  props: { options: Object },
  mounted() {
    Plotly.newPlot(this.$el, this.options.data, this.options.layout, this.options.config);
    this.$el.on("plotly_click", (e) => { const t = e.points[0].customdata; if (typeof t === "number") this.$emit("cell", t); });
    this.sizes = new ResizeObserver(() => {
      const w = this.$el.clientWidth;
      if (w > 0 && w !== this.wide && this.$el.isConnected) { this.wide = w; Plotly.relayout(this.$el, { width: w }); }
    });
    this.sizes.observe(this.$el);
  },
  unmounted() { this.sizes.disconnect(); Plotly.purge(this.$el); },
};
