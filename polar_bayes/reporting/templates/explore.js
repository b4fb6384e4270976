// What the page of a map does: the program of every callback of polar_bayes/reporting/explore.py.
// `about` is text in JSON, `codes` and `readings` are arrays of integers, the rest are models of Bokeh.
const map = JSON.parse(about)
const [height, width] = map.shape
// Code 0 is no number. The others are equal steps, of the logarithm where numbers span decades.
const number = (code, scale) => code == 0 ? NaN
  : scale.is_log ? Math.exp(scale.low + scale.step * (code - 1)) : scale.low + scale.step * (code - 1)
const value = (at, pixel, end) => number(codes[at][end][pixel], map.scales[at][end])
const text = (x, interval) => {
  const digits = interval > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(interval / 8)), 0), 8) : 3
  return Number.isFinite(x) ? x.toFixed(digits) : "–"
}

const paint = () => {
  const at = map.titles.indexOf(choice.value), pixels = picture.data.image[0]
  const limit = map.widths[at][slider.value]
  for (let pixel = 0; pixel < pixels.length; pixel++) {
    const is_wider = slider.value < 100 && !(value(at, pixel, 2) - value(at, pixel, 1) <= limit)
    pixels[pixel] = is_wider ? NaN : value(at, pixel, 0)
  }
  [colors.low, colors.high] = map.colors[at]
  const shown = `${text(limit, limit)}, as in ${slider.value}% of the pixels that have an answer`
  label.text = slider.value < 100 ? `largest 95% width that is shown: ${shown}` : map.any_width
  picture.change.emit()
}

const tight = 'style="white-space: nowrap; padding-left: .6em"'
const describe = (pixel) => {
  const place = `y ${Math.floor(pixel / width) * map.bin}, x ${(pixel % width) * map.bin}`
  const rows = map.titles.map((title, at) => {
    const [mean, low, high] = [0, 1, 2].map(end => value(at, pixel, end))
    const interval = Number.isFinite(mean) ? `[${text(low, high - low)}, ${text(high, high - low)}]` : "–"
    return `<tr><td>${map.markup[at]}</td><td ${tight}>${text(mean, high - low)}</td><td ${tight}>${interval}</td></tr>`
  })
  const k = number(trust[1][pixel], map.scale_of_k).toFixed(2).replace("NaN", "–")
  pane.text = `<b>${map.bin > 1 ? "bin at " : ""}${place}: ${map.statuses[trust[0][pixel]]}, Pareto k ${k}</b>
    <table style="border-spacing: 0 .2em"><tr><td></td><td ${tight}>mean</td><td ${tight}>95% interval</td></tr>${rows.join("")}</table>`
}

const draw = (x, y) => {
  // Of every few pixels one has its readings on the page: the nearest.
  const near = (place, length) => Math.min(Math.round((place * map.bin) / map.step), length - 1)
  const [row, column] = [near(y, map.grid[0]), near(x, map.grid[1])]
  const pixel = row * map.grid[1] + column
  const zeniths = map.zenith.is_own ? pixel * map.views : 0
  const order = [...Array(map.views).keys()].sort((i, j) => angles[zeniths + i] - angles[zeniths + j])
  const mark_of = (kind) => `<span style="color: ${map.inks[kind]}">${["● readings", "× fitted values"][kind]}</span>`
  const kinds = curves[0].map((_, kind) => mark_of(kind)).join(" and ")
  heading.text = `${kinds} of y ${row * map.step}, x ${column * map.step}`
  const zenith = order.map(view => number(angles[zeniths + view], map.zenith.scale))
  curves.forEach((sources, panel) => {
    const columns = sources.map((_, kind) => order.map(
      view => number(readings[panel][kind][pixel * map.views + view], map.panels[panel].scale)))
    const known = columns.flat().filter(Number.isFinite)
    const [low, high] = known.length > 0 ? [Math.min(...known), Math.max(...known)] : [0, 1]
    const margin = 0.1 * (high - low) || 0.1
    Object.assign(ranges[panel], { start: low - margin, end: high + margin })
    sources.forEach((source, kind) => { source.data = { zenith, value: columns[kind] } })
  })
  mark.data = { x: [(column * map.step) / map.bin + 0.5], y: [(row * map.step) / map.bin + 0.5] }
}

if (cb_obj.event_name == undefined) {
  paint()
} else {
  const [x, y] = [Math.floor(cb_obj.x), Math.floor(cb_obj.y)]
  if (x >= 0 && x < width && y >= 0 && y < height) {
    describe(y * width + x)
    if (cb_obj.event_name == "tap" && map.panels.length > 0) draw(x, y)
  }
}
