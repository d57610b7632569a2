// Explorers: a list of cases, switches for curves, buttons for zoom. Each is drawn when it is unfolded.
(function () {
  "use strict";
  var GAP = 65535;

  function unpack(stored, columns) {
    if (typeof stored === "string") { stored = columns[stored]; }
    var raw = atob(stored[2]), out = new Float64Array(raw.length / 2);
    for (var i = 0; i < out.length; i++) {
      var level = raw.charCodeAt(2 * i) + 256 * raw.charCodeAt(2 * i + 1);
      out[i] = level === GAP ? NaN : stored[0] + level * stored[1];
    }
    return out;
  }

  // what is stored deflated in a script of the page
  function inflated(script) {
    var raw = Uint8Array.from(atob(script.textContent), function (letter) { return letter.charCodeAt(0); });
    return new Response(new Blob([raw]).stream().pipeThrough(new DecompressionStream("deflate"))).text();
  }

  function plotOf(name) {
    for (var i = 0; i < Bokeh.documents.length; i++) {
      var model = Bokeh.documents[i].get_model_by_name(name);
      if (model) { return model; }
    }
    return null;
  }

  function color(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }

  function Explorer(root, data) {
    this.root = root;
    this.data = data;
    this.plots = [];
    for (var i = 0; i < this.data.panels; i++) { this.plots.push(plotOf(root.id + "-" + i)); }
    this.wire();
    this.paint();
    this.show(0);
  }

  Explorer.prototype.wire = function () {
    var self = this, list = this.root.querySelector("select");
    if (list) { list.addEventListener("change", function () { self.show(Number(list.value)); }); }
    this.root.querySelectorAll("button[data-step]").forEach(function (button) {
      button.addEventListener("click", function () {
        var next = (Number(list.value) + Number(button.dataset.step) + list.length) % list.length;
        list.value = String(next);
        self.show(next);
      });
    });
    this.root.querySelectorAll("input[type='checkbox']").forEach(function (box) {
      box.addEventListener("change", function () { self.toggle(box.value, box.checked); });
    });
    this.sliders().forEach(function (slider) {
      slider.addEventListener("input", function () { self.cut(); });
    });
    this.root.querySelectorAll("button[data-zoom]").forEach(function (button) {
      button.addEventListener("click", function () { self.zoom(Number(button.dataset.zoom)); });
    });
    this.root.querySelector("button[data-reset]").addEventListener("click", function () { self.reset(); });
    var drag = this.root.querySelector("button[data-drag]");
    drag.addEventListener("click", function () {
      var on = drag.getAttribute("aria-pressed") !== "true";
      drag.setAttribute("aria-pressed", String(on));
      self.plots.forEach(function (plot) {
        plot.toolbar.tools.forEach(function (tool) {
          if (tool.type === "BoxZoomTool") { tool.active = on; }
        });
      });
    });
    this.root.addEventListener("keydown", function (event) {
      if (event.target.tagName === "SELECT" || event.target.tagName === "INPUT") { return; }
      if (event.key === "+") { self.zoom(0.5); } else if (event.key === "-") { self.zoom(2); } else if (event.key === "0") { self.reset(); }
    });
  };

  Explorer.prototype.show = function (number) {
    var one = this.data.cases[number], self = this;
    this.plots.forEach(function (plot, i) {
      var columns = one.panels[i], data = {};
      Object.keys(columns).forEach(function (name) { data[name] = unpack(columns[name], columns); });
      if (self.data.surface && i === 0) { self.lay(data, one.chosen); }
      plot.renderers[0].data_source.data = data;
    });
    if (this.data.surface) { this.cut(); }
    var note = this.root.querySelector(".note");
    if (note) { note.textContent = one.note; }
    this.reset();
  };

  function levels(values) {
    return Array.from(new Set(values.filter(function (value) { return !isNaN(value); }))).sort(function (a, b) { return a - b; });
  }

  function nearest(places, value) {
    var best = 0;
    places.forEach(function (place, i) { if (Math.abs(place - value) < Math.abs(places[best] - value)) { best = i; } });
    return best;
  }

  // the cells of a surface, and the cell that sections begin with
  Explorer.prototype.lay = function (data, chosen) {
    var surface = this.data.surface, x = "x of " + surface.name, self = this;
    // numbers on a page are rounded to a part in 65000 of their range, places of cells are not
    [x, surface.name].forEach(function (name, i) {
      var first = levels(data[name])[0], size = surface.size[i];
      data[name] = data[name].map(function (value) { return first + size * Math.round((value - first) / size); });
    });
    if (surface.logarithmic) { data[surface.heights] = data[surface.heights].map(function (value) { return Math.pow(10, value); }); }
    this.grid = { x: levels(data[x]), y: levels(data[surface.name]), cells: data };
    this.sliders().forEach(function (slider, i) {
      var places = i === 0 ? self.grid.x : self.grid.y;
      slider.max = String(places.length - 1);
      slider.value = String(nearest(places, chosen[i]));
    });
  };

  Explorer.prototype.sliders = function () {
    return Array.prototype.slice.call(this.root.querySelectorAll("input[type='range']"));
  };

  // the sections through the chosen cell: along the horizontal axis, then along the vertical one
  Explorer.prototype.cut = function () {
    var surface = this.data.surface, grid = this.grid, cells = grid.cells, sliders = this.sliders();
    var at = [grid.x[Number(sliders[0].value)], grid.y[Number(sliders[1].value)]];
    var rows = [[[], []], [[], []]];
    cells[surface.heights].forEach(function (height, i) {
      var place = [cells["x of " + surface.name][i], cells[surface.name][i]];
      [0, 1].forEach(function (axis) {
        if (place[1 - axis] === at[1 - axis]) { rows[axis][0].push(place[axis]); rows[axis][1].push(height); }
      });
    });
    var name = surface.section, x = "x of " + name, self = this;
    rows.forEach(function (row, i) {
      var data = {};
      data[x] = row[0];
      data[name] = row[1];
      self.plots[1 + i].renderers[0].data_source.data = data;
    });
    var lines = Object.assign({}, cells), low = NaN, count = cells[name].length;
    var ends = [grid.x[0], grid.x[grid.x.length - 1], low, at[0], at[0]];
    var tops = [at[1], at[1], low, grid.y[0], grid.y[grid.y.length - 1]];
    [[x, ends], [name, tops]].forEach(function (pair) {
      lines[pair[0]] = Array.from({ length: count }, function (_, i) { return i < 5 ? pair[1][i] : NaN; });
    });
    this.plots[0].renderers[0].data_source.data = lines;
    sliders.forEach(function (slider, i) {
      var told = String(Number(at[i].toPrecision(6)));
      slider.nextElementSibling.textContent = told;
      slider.setAttribute("aria-valuetext", told);
    });
  };

  Explorer.prototype.toggle = function (name, on) {
    this.plots.forEach(function (plot) {
      plot.renderers.forEach(function (curve) { if (curve.name === name) { curve.visible = on; } });
    });
  };

  Explorer.prototype.ranges = function () {
    // time axes share one range, which must move once
    var found = [];
    this.plots.forEach(function (plot) {
      [plot.x_range, plot.y_range].forEach(function (range, axis) {
        var whole = axis === 1 && plot.x_range !== range && !plot.match_aspect;
        if (found.indexOf(range) < 0 && !whole) { found.push(range); }
      });
    });
    return found;
  };

  Explorer.prototype.zoom = function (factor) {
    this.ranges().forEach(function (range) {
      var middle = (range.start + range.end) / 2, half = factor * (range.end - range.start) / 2;
      range.setv({ start: middle - half, end: middle + half });
    });
  };

  Explorer.prototype.reset = function () {
    this.plots.forEach(function (plot) { plot.reset.emit(); });
  };

  Explorer.prototype.paint = function () {
    var ink = color("--ink"), line = color("--line"), quiet = color("--quiet"), paper = color("--paper");
    var looks = this.data.looks;
    this.plots.forEach(function (plot) {
      plot.setv({ background_fill_color: paper, border_fill_color: paper, outline_line_color: line });
      if (plot.title && plot.title.setv) { plot.title.text_color = ink; }
      (plot.above.concat(plot.below, plot.left, plot.right, plot.center)).forEach(function (part) {
        if (part.type === "Grid") { part.grid_line_color = line; }
        if (part.type === "Title") { part.text_color = ink; }
        if (part.type === "ColorBar") { part.major_label_text_color = quiet; }
        if (/Axis$/.test(part.type)) {
          part.setv({ major_label_text_color: quiet, axis_label_text_color: ink, axis_line_color: quiet,
            major_tick_line_color: quiet, minor_tick_line_color: null });
        }
      });
      plot.renderers.forEach(function (curve) {
        if (looks[curve.name].color !== "ink" || curve.glyph.type === "Rect") { return; }
        var glyph = curve.glyph, filled = glyph.fill_color && glyph.fill_color.value !== null && /^(Scatter|Patch|VStrip)$/.test(glyph.type);
        glyph[filled ? "fill_color" : "line_color"] = { value: ink };
      });
    });
  };

  function start() {
    var roots = Array.prototype.slice.call(document.querySelectorAll(".explorer"));
    if (!roots.length) { return; }
    if (typeof DecompressionStream === "undefined") {
      document.documentElement.classList.remove("live");
      return;
    }
    var explorers = [];
    var library = inflated(document.getElementById("library")).then(function (text) {
      var script = document.createElement("script");
      script.textContent = text;
      document.head.appendChild(script);
    });

    function draw(root) {
      return Promise.all([inflated(root.querySelector("script")), library]).then(function (texts) {
        var data = JSON.parse(texts[0]);
        return Bokeh.embed.embed_items(data.documents, data.items).then(function () {
          var one = new Explorer(root, data);
          explorers.push(one);
          // frames were laid out before the labels beside them were known
          setTimeout(function () {
            one.plots.forEach(function (plot) { plot.min_border_right = plot.min_border_right - 1; });
          }, 0);
          root.classList.add("drawn");
        });
      });
    }

    // one after the other, so that the first screen stands first; what is folded waits
    var queue = library;
    function look() {
      roots.forEach(function (root) {
        if (root.classList.contains("begun") || root.closest("details:not([open])")) { return; }
        root.classList.add("begun");
        queue = queue.then(function () { return draw(root); }).then(function () {
          return new Promise(function (done) { setTimeout(done, 0); });
        });
      });
    }
    document.addEventListener("toggle", look, true);
    look();
    var dark = window.matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", function () { explorers.forEach(function (one) { one.paint(); }); });
  }
  if (document.readyState === "loading") { document.addEventListener("DOMContentLoaded", start); } else { start(); }
})();
