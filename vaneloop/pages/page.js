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
    legend: {orientation: "h", itemsizing: "constant", x: 0, xanchor: "left", y: 1, yanchor: "bottom", yref: "container"},
    hoverlabel: {bgcolor: c.panel, bordercolor: c.muted, font: {color: c.text}},
    modebar: {orientation: "v", bgcolor: "rgba(0,0,0,0)", color: c.muted, activecolor: c.text},
    colorway: [c.measured, c.model, c.target, c.error, c.other]}});
  const save = (name, type, text) => {
    const a = document.createElement("a");
    a.href = URL.createObjectURL(new Blob([text], {type}));
    a.download = name;
    a.click();
    setTimeout(() => URL.revokeObjectURL(a.href), 1000);
  };
  // a spreadsheet runs text that begins like this as a formula; with an apostrophe in front it does not
  const marked = v => typeof v === "string" && /^'*[=+\-@\t\r]./s.test(v) ? "'" + v : String(v);
  const quoted = v => /[",\r\n]/.test(v) ? '"' + v.replace(/"/g, '""') + '"' : v;
  // every line, bar or cell as a row: name, x, y and what a map's cell holds
  const csv = plot => {
    const rows = [["name", "x", "y", "value"]];
    for (const d of plot._fullData) {
      if (d.visible !== true || d.mode === "text") continue;  // words on a map's cells are no numbers
      if (d.type === "heatmap") {
        d.z.forEach((row, i) => Array.from(row).forEach((z, j) => rows.push([d.name || "", d.x[j], d.y[i], z ?? ""])));
      } else Array.from(d.x).forEach((x, i) => rows.push([d.name || "", x, d.y[i] ?? "", ""]));
    }
    return rows.map(r => r.map(v => quoted(marked(v))).join(",")).join("\n") + "\n";
  };
  const name = plot => (document.title + " " + plot.id).replace(/[^A-Za-z0-9]+/g, "_");
  const button = (title, icon, click) => ({name: title, title, icon, click});
  // the buttons are named one by one: Plotly's own list has one that sends the plot to a server
  const config = {responsive: true, displaylogo: false, displayModeBar: "hover", plotlyServerURL: "",
    modeBarButtons: [["zoom2d", "pan2d", "resetScale2d"], [
      button("save as PNG", Plotly.Icons.camera, p => Plotly.downloadImage(p, {format: "png", scale: 2, filename: name(p)})),
      button("save as SVG", Plotly.Icons.pencil, p => Plotly.downloadImage(p, {format: "svg", filename: name(p)})),
      button("save the numbers as CSV", Plotly.Icons.disk, p => save(name(p) + ".csv", "text/csv", csv(p)))]]};
  // a moment of the log: two seconds to each side in the curves that a map belongs to
  const show = (map, t) => {
    const plot = document.getElementById("p" + map.layout.meta.shows);
    if (!plot || typeof t !== "number") return;
    Plotly.relayout(plot, {"xaxis.range": [t - 2, t + 2], "xaxis.autorange": false});
    plot.scrollIntoView({behavior: "smooth", block: "center"});
  };
  const connect = (map, caption) => {
    if (!map.layout.meta || map.layout.meta.shows === undefined) return;
    map.on("plotly_click", e => show(map, e.points[0].customdata));
    const b = document.createElement("button");
    b.type = "button";
    b.className = "show";
    b.textContent = "Show me the worst moment";
    b.onclick = () => show(map, map.layout.meta.worst);
    caption.append(b);
  };
  const draw = (name, width) => figures.forEach((figure, i) => {
    const c = themes[name], painted = paint(figure, c), element = document.getElementById("p" + i);
    const narrow = !width && element.clientWidth < 560;
    painted.layout.template = template(c);
    if (narrow) {  // a phone: the curves get the width, and the buttons do not cover the names
      painted.layout.template.layout.margin = {l: 44, r: 8, t: 60, b: 46};
      painted.layout.template.layout.font.size = 11;
      for (const a of ["xaxis", "yaxis"]) painted.layout.template.layout[a].title.font = {size: 11};
      painted.layout.template.layout.dragmode = false;
    }
    if (narrow && painted.layout.meta && painted.layout.meta.wide) element.style.width = "1040px";
    painted.layout.uirevision = "keep";
    painted.layout.legend = Object.assign({orientation: "h", itemsizing: "constant", x: 0, y: 1, yanchor: "top", yref: "container"},
      painted.layout.legend);
    if (width) painted.layout.width = element.closest(".pair") ? width / 2 - 24 : width - 24;
    else painted.layout.autosize = true;
    const begun = element.classList.contains("js-plotly-plot");
    Plotly.react(element, painted.data, painted.layout, {...config, displayModeBar: narrow ? false : "hover"});
    if (!begun) connect(element, element.closest("figure").querySelector("figcaption"));
  });
  const screen = () => draw(dark.matches ? "dark" : "light");
  screen();
  dark.addEventListener("change", screen);
  window.addEventListener("beforeprint", () => draw("light", 1010));
  window.addEventListener("afterprint", screen);
})();
