"use strict";
(() => {
  const read = id => JSON.parse(document.getElementById(id).textContent);
  const figures = read("figures"), themes = read("themes");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  // "@role" and "@role/opacity" become the theme's colour
  const paint = (x, c) => {
    if (typeof x === "string" && x[0] === "@") {
      const [role, alpha] = x.slice(1).split("/");
      const colour = c[role];
      if (colour === undefined) return x;
      return alpha === undefined ? colour : colour + Math.round(255 * alpha).toString(16).padStart(2, "0");
    }
    if (Array.isArray(x)) return x.map(v => paint(v, c));
    if (x !== null && typeof x === "object") {
      if (x.bdata !== undefined) return x;
      return Object.fromEntries(Object.entries(x).map(([k, v]) => [k, paint(v, c)]));
    }
    return x;
  };
  const axis = c => ({gridcolor: c.grid, linecolor: c.muted, zerolinecolor: c.muted, zerolinewidth: 1,
    tickcolor: c.muted,
    automargin: true, title: {standoff: 8}, spikecolor: c.muted, spikethickness: 1, spikedash: "solid",
    spikemode: "across"});
  const template = c => ({layout: {
    font: {family: 'system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif',
      size: 13, color: c.text},
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", xaxis: axis(c), yaxis: axis(c),
    margin: {l: 66, r: 44, t: 44, b: 50}, dragmode: "zoom", showlegend: true,
    legend: {orientation: "h", x: 0, xanchor: "left", y: 1, yanchor: "bottom", yref: "container"},
    hoverlabel: {bgcolor: c.panel, bordercolor: c.muted, font: {color: c.text}},
    modebar: {orientation: "v", bgcolor: "rgba(0,0,0,0)", color: c.muted, activecolor: c.text},
    colorway: [c.measured, c.model, c.target, c.error, c.other]}});
  // the buttons are named one by one: Plotly's own list has one that sends the plot to a server
  const config = {responsive: true, displaylogo: false, displayModeBar: "hover", plotlyServerURL: "",
    modeBarButtons: [["zoom2d", "pan2d", "resetScale2d"], ["toImage"]]};
  const draw = (name, width) => figures.forEach((figure, i) => {
    const c = themes[name], painted = paint(figure, c), element = document.getElementById("p" + i);
    painted.layout.template = template(c);
    painted.layout.uirevision = "keep";
    painted.layout.legend = Object.assign({orientation: "h", x: 0, y: 1, yanchor: "top", yref: "container"},
      painted.layout.legend);
    if (width) painted.layout.width = element.closest(".pair") ? width / 2 - 24 : width - 24;
    else painted.layout.autosize = true;
    Plotly.react(element, painted.data, painted.layout, config);
  });
  const screen = () => draw(dark.matches ? "dark" : "light");
  screen();
  dark.addEventListener("change", screen);
  window.addEventListener("beforeprint", () => draw("light", 1010));
  window.addEventListener("afterprint", screen);
})();
