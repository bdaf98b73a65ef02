// Links the plots of the report: one time axis, the place on the map, y axes that fit what is shown, light and dark.
"use strict";
(() => {
  const FITS = JSON.parse(document.getElementById("fits").textContent);
  const root = document.documentElement;
  const model = (name) => Bokeh.documents[0].get_model_by_name(name);
  const figures = () => Object.keys(FITS).map(model);

  // --- Colours

  const paint = () => {
    const style = getComputedStyle(root);
    const [dim, grid, card] = ["--dim", "--grid", "--card"].map((name) => style.getPropertyValue(name).trim());
    for (const one of Bokeh.documents[0].all_models ?? Bokeh.documents[0]._all_models.values()) {
      if (one.properties.major_label_text_color) {
        one.setv({ major_label_text_color: dim, axis_label_text_color: dim, major_tick_line_color: grid });
      } else if (one.properties.grid_line_color && one.grid_line_color !== null) {
        one.grid_line_color = grid;
      } else if (one.properties.bar_line_color) {
        one.setv({ bar_line_color: dim, label_text_color: dim, title_text_color: dim });
      }
    }
  };
  const setTheme = (theme) => {
    root.dataset.theme = theme;
    if (window.Bokeh && Bokeh.documents.length) paint();
  };
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  setTheme(dark.matches ? "dark" : "light");
  dark.addEventListener("change", (event) => setTheme(event.matches ? "dark" : "light"));
  document.getElementById("theme").onclick = () => setTheme(root.dataset.theme === "dark" ? "light" : "dark");

  // --- Time

  const lowerBound = (values, wanted) => {
    let low = 0, high = values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] < wanted) low = middle + 1; else high = middle;
    }
    return low;
  };

  const link = () => {
    const time = model("time");
    const whole = { start: time.start, end: time.end };
    const first = new Map(figures().map((one) => [one, { start: one.y_range.start, end: one.y_range.end }]));
    const track = model("track"), window_ = model("window"), marker = model("marker");
    const output = document.getElementById("range");

    const fit = (figure) => {
      const { curves, always, fixed } = FITS[figure.name];
      if (fixed) return;
      let low = Math.min(...always), high = Math.max(...always);
      for (const [source, column] of curves) {
        const data = model(source).data, values = data[column], t = data.t;
        const stop = lowerBound(t, time.end);
        for (let i = lowerBound(t, time.start); i < stop; i++) {
          if (values[i] < low) low = values[i];
          if (values[i] > high) high = values[i];
        }
      }
      if (!(low <= high)) return;
      const half = Math.max((high - low) * 0.54, 1e-9 * Math.abs(low), 1e-6), middle = (low + high) / 2;
      figure.y_range.setv({ start: middle - half, end: middle + half });
    };

    const show = () => {
      const all = time.start <= whole.start && time.end >= whole.end;
      output.textContent = `${Math.max(0, time.start).toFixed(1)} to ${Math.min(time.end, whole.end).toFixed(1)} s`;
      for (const figure of figures()) {
        if (all) figure.y_range.setv(first.get(figure)); else fit(figure);
      }
      if (track && window_) {
        const a = lowerBound(track.data.t, time.start), b = lowerBound(track.data.t, time.end);
        window_.data = all ? { x: [], y: [] } : { x: track.data.x.slice(a, b), y: track.data.y.slice(a, b) };
      }
    };
    let due = 0;
    const changed = () => { cancelAnimationFrame(due); due = requestAnimationFrame(show); };
    time.properties.start.change.connect(changed);
    time.properties.end.change.connect(changed);

    const go = (start, end) => {
      const width = Math.min(end - start, whole.end - whole.start);
      const from = Math.min(Math.max(start, whole.start), whole.end - width);
      time.setv({ start: from, end: from + width });
    };
    const on = (id, action) => { document.getElementById(id).onclick = () => action(time.end - time.start); };
    on("whole", () => go(whole.start, whole.end));
    on("earlier", (width) => go(time.start - width / 2, time.end - width / 2));
    on("later", (width) => go(time.start + width / 2, time.end + width / 2));
    on("closer", (width) => go(time.start + width / 4, time.end - width / 4));
    on("farther", (width) => go(time.start - width / 2, time.end + width / 2));
    for (const row of document.querySelectorAll("tr[data-second]")) {
      row.onclick = () => go(Number(row.dataset.second) - 5, Number(row.dataset.second) + 5);
    }

    for (const figure of figures()) {
      figure.on_event("doubletap", () => go(whole.start, whole.end));
      if (!track || !marker) continue;
      figure.on_event("mousemove", (event) => {
        const place = Math.min(lowerBound(track.data.t, event.x), track.data.t.length - 1);
        if (place >= 0) marker.data = { x: [track.data.x[place]], y: [track.data.y[place]] };
      });
      figure.on_event("mouseleave", () => { marker.data = { x: [], y: [] }; });
    }
    for (const key of document.querySelectorAll(".key:not([data-curve=''])")) {
      key.onclick = () => {
        const curve = model(key.dataset.curve);
        if (curve) key.classList.toggle("off", !(curve.visible = !curve.visible));
      };
    }
    show();
  };

  const begin = () => {
    if (!window.Bokeh || !Bokeh.documents.length || !Bokeh.documents[0].roots().length) {
      setTimeout(begin, 20);
      return;
    }
    paint();
    if (model("time")) link();
    root.dataset.ready = "yes";
  };
  if (document.querySelector(".panel")) begin(); else root.dataset.ready = "yes";
})();
