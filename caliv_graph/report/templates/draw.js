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
  function draw(plot) {
    const name = plot.dataset.figure;
    const figure = JSON.parse(document.getElementById("data-" + name).textContent);
    return Plotly.newPlot(plot, figure.data, figure.layout, options).then(function () {
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
  plots.reduce(function (before, plot) {
    return before.then(function () { return draw(plot); }).catch(function (error) { broken(plot, error); });
  }, Promise.resolve()).then(function () { document.documentElement.dataset.drawn = "all"; });
})();
