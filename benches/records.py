"""Writes the measured tables of the documentation from the JSON files in docs/records/data.

usage: records.py                    write every table into its page
       records.py --check            fail if a page differs from its JSON
       records.py --take NAME TABLE  put a Markdown table that a script printed ("-": standard input) into NAME.json

A page of docs/ has the table NAME between the lines `<!-- table NAME -->` and `<!-- end -->`, and a part of it after
`<!-- part NAME/ROW, NAME/ROW | COLUMN, COLUMN | CELL -->`. NAME.json has these keys:

title    what the table shows
command  what repeats it, a line or a list of lines that the page has too; null if there is none
commit   the program's; for tables measured before 2026-11-25, the commit that brought the numbers
date     of that commit or of the measurement
machine  in the words of docs/records/index.md; null if nobody wrote it down
seeds    a list of seeds; null if there is no chance in it or nobody wrote them down
spread   what "±" or a range in the table means; null if there is none
units    every value's unit, null for text
columns  {"name", "cell"} from left to right. "cell" has the parts of a cell's text, with values in braces; a part whose values a cell
         lacks is left out. A column without "cell" holds text.
rows     a list for each row: text, null for an empty cell, a number where the column has one value, else {value: number}.
         {"best": true} makes a cell bold. A number is shown with the digits that the file has.
notes    a list of sentences on what the numbers do not show
"""
import datetime
import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
DATA = DOCS / "records" / "data"
KEYS = ["title", "command", "commit", "date", "machine", "seeds", "spread", "units", "columns", "rows", "notes"]
TABLE, PART, END = re.compile(r"<!-- table ([a-z0-9-]+) -->"), re.compile(r"<!-- part (.+) \| (.+) \| (.+) -->"), "<!-- end -->"
FIELD = re.compile(r"\{(\w+)\}")
NUMBER = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"


class Number(str):
    """A number as the file has it."""


class Wrong(Exception):
    pass


def load(name):
    path = DATA / f"{name}.json"
    if not path.exists():
        raise Wrong(f"{path.relative_to(ROOT)}: not there")
    where = path.relative_to(ROOT)
    try:
        table = json.loads(path.read_text(), parse_float=Number, parse_int=Number)
    except ValueError as error:
        raise Wrong(f"{where}: {error}")
    for key in KEYS:
        if key not in table:
            raise Wrong(f"{where}: the key {key} is missing")
    for key in table:
        if key not in KEYS:
            raise Wrong(f"{where}: the key {key} is not known")
    for column in table["columns"]:
        for field in FIELD.findall("".join(column.get("cell", []))):
            if field not in table["units"]:
                raise Wrong(f"{where}: units.{field} is missing")
    for row in table["rows"]:
        if len(row) != len(table["columns"]):
            raise Wrong(f"{where}: a row has {len(row)} cells, the table {len(table['columns'])} columns: {row}")
    return table


def text(cell, column):
    """A cell's Markdown."""
    if cell is None:
        return ""
    if type(cell) is str:
        return cell
    parts = column.get("cell", [])
    fields = FIELD.findall("".join(parts))
    if isinstance(cell, Number):
        if len(fields) != 1:
            raise Wrong(f"column {column['name']}: {cell} stands for one of {fields}")
        cell = {fields[0]: cell}
    for key in cell:
        if key not in [*fields, "best"]:
            raise Wrong(f"column {column['name']}: the value {key} is not shown by its cell")
    shown = [part for part in parts if all(field in cell for field in FIELD.findall(part))]
    filled = FIELD.sub(lambda m: listed(cell[m[1]]), "".join(shown))
    return f"**{filled}**" if cell.get("best") else filled


def listed(value):
    return ", ".join(value) if isinstance(value, list) else value


def grid(columns, rows):
    def line(cells):
        return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells)

    heads = [line(column["name"] for column in columns), line("---" for _ in columns)]
    return heads + [line(map(text, row, columns)) for row in rows]


def whole(name, page):
    """A table and where its numbers are from."""
    table = load(name)
    for command in table["command"] if isinstance(table["command"], list) else [table["command"] or ""]:
        if " ".join(command.split()) not in " ".join(page.read_text().split()):
            raise Wrong(f"the page lacks the command of {name}: {command}")
    seeds = table["seeds"]
    facts = [
        *([] if table["command"] else ["no command repeats them"]),
        f"commit {table['commit']}" if table["commit"] else "commit not recorded",
        table["date"] or "date not recorded",
        table["machine"] or "machine not recorded",
        *([f"seed{'s' if len(seeds) > 1 else ''} {', '.join(seeds)}"] if seeds else []),
    ]
    data = os.path.relpath(DATA / f"{name}.json", page.parent)
    return [*grid(table["columns"], table["rows"]), "", f"[Numbers]({data}): {'; '.join(facts)}."]


def part(rows, names, cell):
    """Some rows and columns of tables, with cells of another form."""
    names, picked = names.split(", "), []
    for row in rows.split(", "):
        name, label = row.split("/")
        table = load(name)
        at = {column["name"]: i for i, column in enumerate(table["columns"])}
        try:
            cells = next(r for r in table["rows"] if r[0] == label)
            picked.append([label, *({f: cells[at[n]][f] for f in FIELD.findall(cell)} for n in names)])
        except (StopIteration, KeyError) as error:
            raise Wrong(f"{name} has no such part: {label}, {error}")
    return grid([{"name": ""}, *({"name": n, "cell": [cell]} for n in names)], picked)


def written(page, used):
    """The page's text with the tables of today."""
    lines, out, at = page.read_text().split("\n"), [], 0
    while at < len(lines):
        out.append(lines[at])
        table, some = TABLE.fullmatch(lines[at]), PART.fullmatch(lines[at])
        if table or some:
            if END not in lines[at:]:
                raise Wrong(f"{lines[at]} has no {END}")
            if table and table[1] in used:
                raise Wrong(f"the table {table[1]} stands in {used[table[1]]} too")
            if table:
                used[table[1]] = page.name
            out += ["", *(whole(table[1], page) if table else part(*some.groups())), "", END]
            at = lines.index(END, at)
        elif lines[at].startswith("|") and page.parent == DATA.parent and page.name != "index.md":
            raise Wrong(f"line {at + 1}: a table without JSON")
        at += 1
    return "\n".join(out)


def pages(check):
    used, differ = {}, []
    for page in sorted(DOCS.rglob("*.md")):
        try:
            new = written(page, used)
        except Wrong as error:
            raise Wrong(f"{page.relative_to(ROOT)}: {error}")
        if new != page.read_text():
            differ.append(str(page.relative_to(ROOT)))
            if not check:
                page.write_text(new)
    for path in sorted(DATA.glob("*.json")):
        if path.stem not in used:
            raise Wrong(f"{path.relative_to(ROOT)}: no page shows it")
    if check and differ:
        raise Wrong(f"{', '.join(differ)}: not what the JSON says; run python3 benches/records.py")


def take(name, source):
    """Puts a printed table's cells, and commit, date and machine of now, into the JSON."""
    table = load(name)
    head, _, *rows = [cells(line) for line in source.splitlines() if line.startswith("|")]
    known = {column["name"]: column for column in table["columns"]}
    usual = table["columns"][-1].get("cell")
    table["columns"] = [known.get(n, {"name": n} | ({"cell": usual} if usual and i else {})) for i, n in enumerate(head)]
    table["rows"] = [[value(cell, column, table["units"]) for cell, column in zip(row, table["columns"])] for row in rows]
    for cell, column in ((cell, column) for row in table["rows"] for cell, column in zip(row, table["columns"])):
        if type(cell) is str and "cell" in column:
            print(f"taken as text, not as numbers: {cell} (column {column['name']})", file=sys.stderr)
    git = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True)
    table |= {"commit": git.stdout.strip(), "date": datetime.date.today().isoformat(), "machine": machine()}
    (DATA / f"{name}.json").write_text(dump(table))


def cells(line):
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]


def value(cell, column, units):
    """The reverse of `text`."""
    if not cell:
        return None
    parts = column.get("cell")
    if not parts:
        return cell
    bold = re.fullmatch(r"\*\*(.*)\*\*", cell)
    fields = FIELD.findall("".join(parts))
    pattern = ""
    for part in parts:
        literal = FIELD.split(part)
        literal[::2] = map(re.escape, literal[::2])
        literal[1::2] = [f"(?P<{field}>.+)" if units[field] is None else rf"\+?(?P<{field}>{NUMBER})" for field in literal[1::2]]
        pattern += f"(?:{''.join(literal)})?"
    match = re.fullmatch(pattern, bold[1] if bold else cell)
    if not match:
        return cell
    found = {f: Number(x) if units[f] is not None else x.split(", ") for f, x in match.groupdict().items() if x is not None}
    if len(fields) == 1 and not bold and units[fields[0]] is not None:
        return found[fields[0]]
    return found | ({"best": True} if bold else {})


def machine():
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text()) if info.exists() else []
    return f"{os.cpu_count()} cores of {names[0] if names else platform.processor() or platform.machine()}"


def dump(table):
    """JSON with a line for each column and each row."""
    def one(value):
        if isinstance(value, Number):
            return str(value)
        if isinstance(value, dict):
            return "{" + ", ".join(f"{json.dumps(k)}: {one(v)}" for k, v in value.items()) + "}"
        if isinstance(value, list):
            return "[" + ", ".join(map(one, value)) + "]"
        return json.dumps(value, ensure_ascii=False)

    def entry(key):
        value = table[key]
        if key in ("columns", "rows", "notes") and value:
            return f'  "{key}": [\n' + ",\n".join(f"    {one(item)}" for item in value) + "\n  ]"
        return f'  "{key}": {one(value)}'

    return "{\n" + ",\n".join(map(entry, KEYS)) + "\n}\n"


if __name__ == "__main__":
    try:
        match sys.argv[1:]:
            case []:
                pages(check=False)
            case ["--check"]:
                pages(check=True)
            case ["--take", name, source]:
                take(name, sys.stdin.read() if source == "-" else Path(source).read_text())
            case _:
                sys.exit(__doc__)
    except Wrong as error:
        sys.exit(str(error))
