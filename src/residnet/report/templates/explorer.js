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
    var ink = color("--ink"), line = color("--line"), quiet = color("--quiet"), paper = color("--paper");
    var looks = this.data.looks;
    this.plots.forEach(function (plot) {
      plot.setv({ background_fill_color: paper, border_fill_color: paper, outline_line_color: line });
      if (plot.title && plot.title.setv) { plot.title.text_color = ink; }
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
