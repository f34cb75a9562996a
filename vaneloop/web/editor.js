// A curve whose points are dragged up and down. The server gets the point's number and its new value when it is let go.
export default {
  template: `<svg ref="svg" class="editor" :viewBox="'0 0 ' + W + ' ' + H" role="group" aria-label="curve to edit"
      @pointermove="move" @pointerup="drop" @pointerleave="drop">
    <g v-for="t in ticks.y" :key="'y' + t"><line :x1="L" :x2="W - 10" :y1="py(t)" :y2="py(t)" class="editor-grid"/><text :x="L - 6" :y="py(t) + 4" text-anchor="end">{{ t }}</text></g>
    <g v-for="t in ticks.x" :key="'x' + t"><line :x1="px(t)" :x2="px(t)" :y1="10" :y2="H - B" class="editor-grid"/><text :x="px(t)" :y="H - B + 16" text-anchor="middle">{{ t }}</text></g>
    <text :x="W - 10" :y="H - 4" text-anchor="end">{{ xtitle }}</text><text :x="L + 6" y="20">{{ ytitle }}</text>
    <polyline :points="x.map((v, i) => px(v) + ',' + py(now[i])).join(' ')" class="editor-line"/>
    <circle v-for="(v, i) in x" :key="i" :cx="px(v)" :cy="py(now[i])" r="6" class="editor-point" tabindex="0" role="slider" :aria-label="'point at ' + v" :aria-valuenow="now[i]" :aria-valuemin="range[0]" :aria-valuemax="range[1]"
      @pointerdown.prevent="grab(i, $event)" @keydown.up.prevent="nudge(i, 0.1)" @keydown.down.prevent="nudge(i, -0.1)"/>
    <text v-if="held !== null" :x="px(x[held])" :y="py(now[held]) - 12" text-anchor="middle" class="editor-value">{{ now[held].toFixed(2) }}</text>
  </svg>`,
  props: { x: Array, y: Array, xtitle: String, ytitle: String },
  data() { return { now: [...this.y], held: null, W: 760, H: 300, L: 48, B: 34 }; },
  mounted() { // on a phone fewer units across, so that the words keep their size
    this.sized = new ResizeObserver(() => { this.W = this.$refs.svg.clientWidth < 560 ? 340 : 760; });
    this.sized.observe(this.$refs.svg);
  },
  unmounted() { this.sized.disconnect(); },
  watch: { y(v) { if (this.held === null) this.now = [...v]; } },
  computed: {
    range() { const a = Math.min(...this.y), b = Math.max(...this.y), m = 0.12 * (b - a) || 1; return [a - m, b + m]; },
    ticks() {
      const make = (a, b, n) => { const raw = (b - a) / n, s = Math.pow(10, Math.floor(Math.log10(raw))), d = [1, 2, 5, 10].map((k) => k * s).find((k) => k >= raw);
        const out = []; for (let v = Math.ceil(a / d) * d; v <= b + 1e-9; v += d) out.push(+v.toFixed(6)); return out; };
      return { x: make(this.x[0], this.x[this.x.length - 1], this.W < 560 ? 4 : 8), y: make(...this.range, 6) };
    },
  },
  methods: {
    px(v) { return this.L + ((v - this.x[0]) / (this.x[this.x.length - 1] - this.x[0])) * (this.W - this.L - 14); },
    py(v) { const [a, b] = this.range; return this.H - this.B - ((v - a) / (b - a)) * (this.H - this.B - 10); },
    grab(i, e) { this.held = i; this.$refs.svg.setPointerCapture(e.pointerId); },
    move(e) {
      if (this.held === null) return;
      const box = this.$refs.svg.getBoundingClientRect(), [a, b] = this.range;
      const v = a + ((this.H - this.B - ((e.clientY - box.top) * this.H) / box.height) / (this.H - this.B - 10)) * (b - a);
      const i = this.held;
      const low = i > 0 ? this.now[i - 1] : -90, high = i < this.now.length - 1 ? this.now[i + 1] : 90; // a schedule rises
      this.now[i] = Math.round(100 * Math.min(high, Math.max(low, v))) / 100;
    },
    drop() { if (this.held === null) return; const i = this.held; this.held = null; this.$emit("moved", [i, this.now[i]]); },
    nudge(i, d) { this.now[i] = Math.round(100 * (this.now[i] + d)) / 100; this.$emit("moved", [i, this.now[i]]); },
  },
};
