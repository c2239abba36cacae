// Viewer of CSV tables: tables.html?file=PATH.csv. Sorts by a click on a column, filters by words. No network.
"use strict";

// Split CSV text into rows of cells; a cell in quotes may hold commas, quotes (doubled) and line breaks.
function parseCsv(text) {
  const rows = [[""]];
  let quoted = false;
  for (let at = 0; at < text.length; at++) {
    const letter = text[at];
    const row = rows[rows.length - 1];
    if (quoted) {
      if (letter !== '"') row[row.length - 1] += letter;
      else if (text[at + 1] === '"') row[row.length - 1] += text[++at];
      else quoted = false;
    } else if (letter === '"') quoted = true;
    else if (letter === ",") row.push("");
    else if (letter === "\n") rows.push([""]);
    else if (letter !== "\r") row[row.length - 1] += letter;
  }
  return rows.filter((row) => row.length > 1 || row[0] !== "");
}

// The number in a cell, infinite ones and thousands with commas too; NaN for other text.
function numberIn(cell) {
  const plain = cell.replace(/,(?=\d{3})/g, "");
  if (plain === "inf") return Infinity;
  if (plain === "-inf") return -Infinity;
  return plain.trim() === "" ? NaN : Number(plain.replace(/%$/, ""));
}

// A long fraction rounded to four significant digits; every other cell as in the file.
function shown(cell) {
  const number = numberIn(cell);
  if (!Number.isFinite(number) || Number.isInteger(number) || !/^-?[\d.]+(e-?\d+)?$/i.test(cell)) return cell;
  if (cell.replace(/[-.]/g, "").replace(/^0+/, "").length <= 4) return cell;
  const places = Math.max(0, 3 - Math.floor(Math.log10(Math.abs(number))));
  return number.toFixed(Math.min(places, 6));
}

function compareCells(one, other) {
  const [left, right] = [numberIn(one), numberIn(other)];
  if (!Number.isNaN(left) && !Number.isNaN(right)) return left < right ? -1 : left > right ? 1 : 0;
  if (Number.isNaN(left) !== Number.isNaN(right)) return Number.isNaN(left) ? 1 : -1;
  return one.localeCompare(other);
}

function add(parent, name, text = "", attributes = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}

const viewer = document.getElementById("table-viewer");
const asked = new URLSearchParams(location.search);
const file = asked.get("file") ?? "";

function listTables() {
  add(viewer, "p", file ? `There is no table ${file}.` : "Every table of the result pages.");
  const list = add(viewer, "ul");
  for (const [name, page] of Object.entries(knownTables)) {
    const item = add(list, "li");
    add(item, "a", name, { href: `tables.html?file=${encodeURIComponent(name)}` });
    item.append(` of ${page.title}`);
  }
}

// Called by the script of a table with the text of its CSV file.
function showTable(text) {
  const [header, ...rows] = parseCsv(text);
  const numeric = header.map((_, at) => rows.some((row) => !Number.isNaN(numberIn(row[at] ?? ""))));
  const tools = add(viewer, "div", "", { class: "tools" });
  const filter = add(tools, "input", "", {
    type: "search", placeholder: "filter: words, all must match", "aria-label": "filter rows",
  });
  filter.value = asked.get("filter") ?? "";
  const count = add(tools, "span", "", { "aria-live": "polite" });
  add(tools, "a", "CSV file", { href: file, download: "" });
  const page = knownTables[file];
  add(tools, "a", `to the page: ${page.title}`, { href: page.url });
  const table = add(add(viewer, "div", "", { class: "scroll" }), "table", "", { class: "viewer" });
  const heads = add(add(table, "thead"), "tr");
  const body = add(table, "tbody");
  let sorted = -1;
  let rising = true;

  function draw() {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const kept = rows.filter((row) => words.every((word) => row.some((cell) => cell.toLowerCase().includes(word))));
    if (sorted >= 0) {
      kept.sort((one, other) => {
        const [left, right] = [one[sorted] ?? "", other[sorted] ?? ""];
        if ((left === "") !== (right === "")) return left === "" ? 1 : -1;
        return rising ? compareCells(left, right) : compareCells(right, left);
      });
    }
    body.replaceChildren();
    for (const row of kept) {
      const line = add(body, "tr");
      row.forEach((cell, at) => add(line, "td", shown(cell), { title: cell, class: numeric[at] ? "number" : "text" }));
    }
    count.textContent = `${kept.length} of ${rows.length} rows`;
    [...heads.children].forEach((head, at) => {
      head.setAttribute("aria-sort", at !== sorted ? "none" : rising ? "ascending" : "descending");
      head.firstChild.textContent = header[at].replaceAll("_", " ") + (at !== sorted ? "" : rising ? " ▲" : " ▼");
    });
  }

  header.forEach((name, at) => {
    add(add(heads, "th"), "button", name, { type: "button" }).addEventListener("click", () => {
      [sorted, rising] = [at, sorted === at ? !rising : true];
      draw();
    });
  });
  filter.addEventListener("input", draw);
  draw();
}

if (Object.hasOwn(knownTables, file)) {
  document.querySelector("h1").firstChild.textContent = file;
  add(document.body, "script", "", { src: `tables/${file}.js` });
} else {
  listTables();
}
