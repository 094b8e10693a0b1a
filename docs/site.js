// Tables of data (tools/site.py makes them of docs/data/*.csv): a header sorts by its column.
for (const table of document.querySelectorAll("table.data")) {
  const body = table.tBodies[0];
  const headers = [...table.tHead.rows[0].cells];
  headers.forEach((header, column) => {
    header.firstElementChild.addEventListener("click", () => {
      const down = header.getAttribute("aria-sort") === "ascending";
      const sorted = [...body.rows]
        .map((row) => [row, row.cells[column].textContent.trim()])
        .sort(([, a], [, b]) => (down ? -1 : 1) * compare(a, b) || empty(a) - empty(b));
      headers.forEach((other) => other.removeAttribute("aria-sort"));
      header.setAttribute("aria-sort", down ? "descending" : "ascending");
      body.append(...sorted.map(([row]) => row));
    });
  });
}

function empty(text) {
  return text === "" || text === "-";
}

// Numbers as numbers, before words; what is empty comes last either way.
function compare(a, b) {
  if (empty(a) || empty(b)) return 0;
  const [x, y] = [a, b].map((text) => Number(text.replace(/[,\s]|%$/g, "")));
  if (!isNaN(x) && !isNaN(y)) return x - y;
  return isNaN(x) - isNaN(y) || a.localeCompare(b, undefined, { numeric: true });
}
