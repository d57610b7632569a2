// Explorers: a list of cases, switches for curves, buttons for zoom. Loaded after BokehJS.
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

  function Explorer(root) {
    this.root = root;
    this.data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
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
    var one = this.data.cases[number];
    this.plots.forEach(function (plot, i) {
      var columns = one.panels[i], data = {};
      Object.keys(columns).forEach(function (name) { data[name] = unpack(columns[name], columns); });
      plot.renderers[0].data_source.data = data;
    });
    var note = this.root.querySelector(".note");
    if (note) { note.textContent = one.note; }
    this.reset();
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
    var ink = color("--ink"), line = color("--line"), quiet = color("--quiet"), looks = this.data.looks;
    this.plots.forEach(function (plot) {
      plot.setv({ background_fill_color: null, border_fill_color: null, outline_line_color: line });
      (plot.above.concat(plot.below, plot.left, plot.right, plot.center)).forEach(function (part) {
        if (part.type === "Grid") { part.grid_line_color = line; }
        if (part.type === "Title") { part.text_color = ink; }
        if (/Axis$/.test(part.type)) {
          part.setv({ major_label_text_color: quiet, axis_label_text_color: ink, axis_line_color: quiet,
            major_tick_line_color: quiet, minor_tick_line_color: null });
        }
      });
      plot.renderers.forEach(function (curve) {
        if (looks[curve.name].color !== "ink") { return; }
        var part = curve.glyph.type === "Line" ? "line_color" : "fill_color";
        curve.glyph[part] = { value: ink };
      });
    });
  };

  function start() {
    var roots = Array.prototype.slice.call(document.querySelectorAll(".explorer"));
    if (!roots.length || typeof Bokeh === "undefined") { return; }
    var wait = setInterval(function () {
      var ready = roots.every(function (root) { return plotOf(root.id + "-0"); });
      if (!ready) { return; }
      clearInterval(wait);
      var explorers = roots.map(function (root) { return new Explorer(root); });
      // frames were laid out before the labels beside them were known
      setTimeout(function () {
        explorers.forEach(function (one) {
          one.plots.forEach(function (plot) { plot.min_border_right = plot.min_border_right - 1; });
        });
      }, 0);
      document.documentElement.classList.add("drawn");
      var dark = window.matchMedia("(prefers-color-scheme: dark)");
      dark.addEventListener("change", function () { explorers.forEach(function (one) { one.paint(); }); });
    }, 20);
  }
  if (document.readyState === "loading") { document.addEventListener("DOMContentLoaded", start); } else { start(); }
})();
