"use strict";
(function () {
  const options = { displaylogo: false, responsive: false, showSendToCloud: false, modeBarButtonsToRemove: ["sendDataToCloud"] };
  // Browsers print WebGL canvases empty, so a picture of each 3-D view replaces it in print.
  function keepStill(plot) {
    return Plotly.toImage(plot, { format: "png", width: plot.offsetWidth, height: plot.offsetHeight, scale: 1.5 }).then(function (url) {
      let still = plot.parentNode.querySelector("img.still");
      if (!still) {
        still = document.createElement("img");
        still.className = "still";
        still.alt = plot.parentNode.querySelector("figcaption").textContent;
        plot.parentNode.insertBefore(still, plot.nextSibling);
      }
      still.src = url;
      plot.classList.add("has-still");
    });
  }
  const dark = window.matchMedia("(prefers-color-scheme: dark)").matches;
  // Colours of figures that are made for white paper. Data in base64 have no quotes.
  const darkened = { "#000000": "#f2f2f2", "#1A1A1A": "#e6e6e6", "#2a3f5f": "#e6e6e6", "white": "#16181b", "#F7F7F7": "#1d2024", "#DDDDDD": "#3a3f45", "#EBF0F8": "#2f343a", "#DFE8F3": "#2f343a", "#0072B2": "#4da3e0" };
  function coloured(text) {
    if (!dark) { return text; }
    for (const [from, to] of Object.entries(darkened)) { text = text.split('"' + from + '"').join('"' + to + '"'); }
    return text;
  }
  // plotly.js draws the button that is pressed nearly white, with the figure's letters on it.
  function legible(layout) {
    for (const menu of dark && layout.updatemenus || []) { Object.assign(menu, { bgcolor: "#aab2bb", font: { color: "#1a1a1a" } }); }
  }
  // On a narrow screen, panels that are side by side go one below another.
  function fit(layout, plot) {
    const width = plot.clientWidth, count = Number(plot.parentNode.dataset.across);
    if (width >= layout.width) { return; }
    layout.width = width;
    layout.height = plot.clientHeight;
    layout.margin = Object.assign({}, layout.margin, { l: 48, r: 8 });
    const inner = layout.height - layout.margin.t - layout.margin.b, gap = 95 / inner;
    if (layout.legend) { layout.legend.y = 1 + 24 / inner; }
    if (width > 640) { return; }
    // A row of buttons would go beyond the edge.
    for (const menu of layout.updatemenus || []) { Object.assign(menu, { type: "dropdown", direction: "down" }); }
    if (count < 2) { return; }
    for (let i = 0; i < count; i += 1) {
      const number = i ? String(i + 1) : "", size = (1 - gap * (count - 1)) / count;
      const top = 1 - i * (size + gap), domain = [Math.max(top - size, 0), top];
      if (layout["scene" + number]) { layout["scene" + number].domain = { x: [0, 1], y: domain }; }
      if (layout["xaxis" + number]) { layout["xaxis" + number].domain = [0, 1]; }
      if (layout["yaxis" + number]) { layout["yaxis" + number].domain = domain; }
      if (layout.annotations && layout.annotations[i]) { Object.assign(layout.annotations[i], { x: 0.5, y: top }); }
    }
  }
  function draw(plot) {
    const name = plot.dataset.figure;
    const figure = JSON.parse(coloured(document.getElementById("data-" + name).textContent));
    fit(figure.layout, plot);
    legible(figure.layout);
    plot.textContent = "";
    // The bar of buttons would cover the legend of a narrow figure.
    const bar = figure.layout.width < 640 ? { displayModeBar: false } : {};
    return Plotly.newPlot(plot, figure.data, figure.layout, Object.assign(bar, options)).then(function () {
      if (!plot.parentNode.classList.contains("solid")) { return undefined; }
      plot.on("plotly_relayout", function () { keepStill(plot); });
      return keepStill(plot);
    }).then(function () { plot.dataset.drawn = "yes"; });
  }
  function broken(plot, error) {
    plot.classList.add("broken");
    const why = plot.parentNode.classList.contains("solid") ? " (3-D views need WebGL)" : "";
    plot.textContent = "This figure could not be drawn" + why + ": " + error;
  }
  // One after the other, flat figures first: the page is readable while 3-D views are prepared.
  const plots = Array.from(document.querySelectorAll(".plot"));
  const solid = function (plot) { return plot.parentNode.classList.contains("solid") ? 1 : 0; };
  plots.sort(function (a, b) { return solid(a) - solid(b); });
  // A pause before each: the page can be scrolled meanwhile.
  function pause() { return new Promise(function (go) { setTimeout(go, 0); }); }
  plots.reduce(function (before, plot) {
    return before.then(pause).then(function () { return draw(plot); }).catch(function (error) { broken(plot, error); });
  }, Promise.resolve()).then(function () { document.documentElement.dataset.drawn = "all"; });
})();
