// Colours, marks and axes of the explorer; explorer.js follows in the same function.
"use strict";

const MARGIN = { left: 64, right: 14, top: 12, bottom: 50 }; // room for the axes [px]
const VIRIDIS = ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"];
const FONT = '13px system-ui, "Segoe UI", Roboto, sans-serif';
// Corners in units of the radius; a mark without corners is a circle.
const CORNERS = {
  diamond: [[0, -1.35], [1.35, 0], [0, 1.35], [-1.35, 0]],
  triangle: [[0, -1.35], [1.3, 0.95], [-1.3, 0.95]],
};

// The colour at a share of the way along a scale.
function shade(scale, share) {
  const place = Math.min(Math.max(share, 0), 1) * (scale.length - 1);
  const index = Math.min(Math.floor(place), scale.length - 2);
  const channel = (hex, i) => parseInt(hex.slice(1 + 2 * i, 3 + 2 * i), 16);
  const mix = [0, 1, 2].map((i) => {
    const [a, b] = [channel(scale[index], i), channel(scale[index + 1], i)];
    return Math.round(a + (place - index) * (b - a));
  });
  return `rgb(${mix.join(",")})`;
}

function drawMark(pen, x, y, radius, mark, fill, edge, width) {
  pen.beginPath();
  if (!CORNERS[mark]) pen.arc(x, y, radius, 0, 2 * Math.PI);
  else CORNERS[mark].forEach(([right, down]) => pen.lineTo(x + radius * right, y + radius * down));
  pen.closePath();
  pen.fillStyle = fill;
  pen.fill();
  if (!edge) return;
  pen.strokeStyle = edge;
  pen.lineWidth = width;
  pen.stroke();
}

function ticks(low, high) {
  const rough = (high - low) / 8;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough);
  const digits = Math.max(0, -Math.floor(Math.log10(step)));
  const values = [];
  for (let k = Math.ceil(low / step); k * step <= high; k += 1) values.push(k * step);
  return values.map((value) => [value, value.toFixed(digits).replace("-", "−")]);
}

function drawAxes(pen, view, names) {
  const [left, top] = [MARGIN.left, MARGIN.top];
  const [right, bottom] = [left + view.width, top + view.height];
  pen.font = FONT;
  pen.fillStyle = "#1d2129";
  pen.lineWidth = 1;
  const line = (stroke, ...points) => {
    pen.strokeStyle = stroke;
    pen.beginPath();
    points.forEach(([x, y]) => pen.lineTo(x, y));
    pen.stroke();
  };
  pen.textAlign = "center";
  for (const [value, label] of ticks(view.low[0], view.high[0])) {
    line("#e6e6e6", [view.x(value), top], [view.x(value), bottom]);
    pen.fillText(label, view.x(value), bottom + 18);
  }
  pen.textAlign = "right";
  for (const [value, label] of ticks(view.low[1], view.high[1])) {
    line("#e6e6e6", [left, view.y(value)], [right, view.y(value)]);
    pen.fillText(label, left - 8, view.y(value) + 4);
  }
  line("#1d2129", [left, top], [left, bottom], [right, bottom]);
  pen.textAlign = "center";
  pen.fillText(names[0], left + view.width / 2, bottom + 42);
  pen.save();
  pen.translate(15, top + view.height / 2);
  pen.rotate(-Math.PI / 2);
  pen.fillText(names[1], 0, 0);
  pen.restore();
}
