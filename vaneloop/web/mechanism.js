// The linkage of the stages drawn to scale at any stroke: joints come from the server for a raster of strokes, the slider moves here.
export default {
  template: `<div class="mech">
    <div class="rowc" style="flex-wrap:nowrap;width:100%">
      <button type="button" class="mech-play" @click="play" :aria-label="timer ? 'stop' : 'move'">{{ timer ? '&#10073;&#10073;' : '&#9654;' }}</button>
      <input type="range" min="0" :max="last" step="1" v-model.number="k" aria-label="stroke" style="flex:1">
      <span class="mono" style="width:90px;text-align:right">{{ strokes[k] === undefined ? '' : strokes[k].toFixed(1) + ' mm' }}</span>
    </div>
    <div class="mech-row">
      <figure v-for="s in drawn" :key="s.name" style="margin:0;min-width:0">
        <svg :viewBox="s.box" preserveAspectRatio="xMidYMid meet" role="img" :aria-label="'mechanism of ' + s.name">
          <path :d="s.ring" class="mech-ring" :style="{strokeWidth: s.w}"/>
          <path :d="s.actuator" class="mech-actuator" :style="{strokeWidth: 3.2 * s.w}"/>
          <path :d="s.crank" class="mech-crank" :style="{strokeWidth: 3.2 * s.w}"/>
          <path :d="s.link" class="mech-link" :style="{strokeWidth: 3.2 * s.w}"/>
          <path :d="s.arm" class="mech-arm" :style="{strokeWidth: 2 * s.w}"/>
          <circle v-for="(p, i) in s.points" :key="i" :cx="p[0]" :cy="p[1]" :r="3.4 * s.w" :class="i === 0 || i === 2 || i === 5 ? 'mech-fixed' : 'mech-joint'" :style="{strokeWidth: 1.5 * s.w}"/>
        </svg>
        <figcaption class="small"><b>{{ s.name }}</b> <span class="mono">{{ s.angle }}</span></figcaption>
      </figure>
    </div></div>`,
  props: { strokes: Array, stages: Array },
  data() { return { k: Math.floor((this.strokes.length - 1) / 2), timer: null, step: 1 }; },
  unmounted() { clearInterval(this.timer); },
  computed: {
    last() { return this.strokes.length - 1; },
    drawn() {
      const k = Math.min(this.k, this.last);
      return this.stages.map((s) => {
        const all = s.joints.flat();
        const xs = all.map((p) => p[0]).concat(s.joints[0][5][0] - s.radius, s.joints[0][5][0] + s.radius);
        const ys = all.map((p) => -p[1]).concat(-s.joints[0][5][1] - s.radius, -s.joints[0][5][1] + s.radius);
        const x0 = Math.min(...xs), x1 = Math.max(...xs), y0 = Math.min(...ys), y1 = Math.max(...ys), m = 0.05 * Math.max(x1 - x0, y1 - y0);
        const p = s.joints[k].map(([x, y]) => [x, -y]);
        const line = (...q) => "M" + q.map((v) => v[0].toFixed(2) + " " + v[1].toFixed(2)).join("L");
        const [cx, cy] = p[5], r = s.radius;
        return {
          name: s.name, points: p, w: Math.max(x1 - x0, y1 - y0) / 330,
          box: [x0 - m, y0 - m, x1 - x0 + 2 * m, y1 - y0 + 2 * m].join(" "),
          ring: `M${cx - r} ${cy}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`,
          actuator: line(p[0], p[1]), crank: line(p[1], p[2], p[3]), link: line(p[3], p[4]), arm: line(p[4], p[5]),
          angle: s.angles[k].toFixed(2) + " deg",
        };
      });
    },
  },
  methods: {
    play() {
      if (this.timer) { clearInterval(this.timer); this.timer = null; return; }
      this.timer = setInterval(() => {
        if (this.k + this.step > this.last || this.k + this.step < 0) this.step = -this.step;
        this.k += this.step;
      }, 40);
    },
  },
};
