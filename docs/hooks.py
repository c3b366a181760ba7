"""Pages that are generated when the site is built, so that they are never out of date.

The command's help and the JSON Schemas come from the program: the one that CONEFIELD names, else target/release/conefield. The Python page
comes from the docstrings, the C page from the header.
"""

import ast
import json
import os
import re
import subprocess
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent


def on_files(files, config):
    program = find_program()
    pages = {
        "reference/commands.md": commands(program),
        "reference/spec-keys.md": keys("Spec keys", SPEC_KEYS, run(program, "schema")),
        "reference/study-keys.md": keys("Study keys", STUDY_KEYS, run(program, "schema", "--study")),
        "reference/python.md": python_api(),
        "reference/c-header.md": c_header(),
    }
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def find_program():
    built = [ROOT / "target" / "release" / "conefield"]
    named = [Path(os.environ["CONEFIELD"])] if "CONEFIELD" in os.environ else []
    for path in named or built:
        if path.is_file():
            return path
    raise PluginError("the reference needs the program: cargo build --release --bin conefield, or set CONEFIELD to its path")


def run(program, *arguments):
    # Help is wrapped to the terminal's width: the same on every machine.
    env = os.environ | {"COLUMNS": "100"}
    return subprocess.run([program, *arguments], check=True, capture_output=True, text=True, env=env).stdout


def commands(program):
    lines = ["# Commands", "", "The output of `conefield COMMAND --help`.", ""]
    for words in subcommands(program, []):
        title = " ".join(["conefield", *words])
        lines += [f"## {title}", "", "```text", run(program, *words, "--help").strip(), "```", ""]
    return "\n".join(lines)


def subcommands(program, parent):
    """The program, its commands and their subcommands, as `--help` lists them."""
    yield parent
    help_text = run(program, *parent, "--help")
    if "\nCommands:\n" not in help_text:
        return
    block = help_text.split("\nCommands:\n")[1].split("\n\n")[0]
    for name in re.findall(r"^  ([a-z]+)\b", block, flags=re.M):
        if name != "help":
            yield from subcommands(program, [*parent, name])


SPEC_KEYS = """Every key of a spec file, from `conefield schema`. A stage is written as a table with its `type`, or as the name of the
type alone where its settings keep their defaults. [Composing methods](../guide/specs.md) explains how a spec is put together."""
STUDY_KEYS = """Every key of a study file, from `conefield schema --study`. [Many scans](../guide/many-scans.md) explains studies."""


def keys(title, intro, schema_text):
    """A table of keys for every object of a JSON Schema that has keys."""
    schema = json.loads(schema_text)
    lines = [f"# {title}", "", intro, ""]
    for name, entry in [("The file", {**schema, "allOf": []}), *sorted(schema.get("$defs", {}).items())]:
        rows = list(properties(entry, schema))
        if rows and (name == "The file" or "." in name):
            described = " ".join(entry.get("description", "").split())
            lines += [f"## {name}", "", described, "", "| key | meaning | default |", "| --- | --- | --- |", *rows, ""]
    return "\n".join(lines)


def properties(entry, schema, prefix=""):
    """A row for every key of the objects that an entry may be, and for the keys below it."""
    seen = set()
    for shape in shapes(entry, schema):
        for key, value in shape["properties"].items():
            if key in seen or not isinstance(value, dict) or key == "type" and "const" in value or key == "$schema":
                continue
            seen.add(key)
            default = f"`{json.dumps(value['default'])}`" if "default" in value else ""
            yield f"| `{prefix}{key}` | {cell(value.get('description') or shape.get('description', ''))} | {default} |"
            yield from properties(value, schema, f"{prefix}{key}.")


def shapes(entry, schema):
    """The objects with keys that an entry may be. A reference to a kind of stage is not followed: it has a section."""
    if "properties" in entry:
        yield entry
    nested = [shape for word in ("oneOf", "anyOf", "allOf") for shape in entry.get(word, [])]
    if isinstance(entry.get("items"), dict):
        nested.append(entry["items"])
    path = entry.get("$ref", "").removeprefix("#/$defs/").split("/$defs/")
    if path != [""] and (len(path) > 1 or "method" not in schema["$defs"]):
        definitions = schema
        for part in path:
            definitions = definitions["$defs"][part]
        nested.append(definitions)
    for shape in nested:
        yield from shapes(shape, schema)


def cell(text):
    return " ".join(str(text).split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[").replace("*", "\\*")


def python_api():
    """Signatures and docstrings of what the package exports."""
    package = ROOT / "python" / "conefield"
    init = ast.parse((package / "__init__.py").read_text())
    native = definitions(package / "_native.pyi")
    lines = ["# Python package", "", ast.get_docstring(init), ""]
    for node in init.body:
        if not isinstance(node, ast.ImportFrom) or node.level != 1:
            continue
        module = package / f"{node.module}.py"
        source = module if module.exists() else module.with_suffix(".pyi")
        found = native | definitions(source)
        for alias in node.names:
            if alias.name in found:
                lines += entry(found[alias.name])
    return re.sub(":(class|func|meth):", "", "\n".join(lines))


def definitions(source):
    return {item.name: item for item in ast.parse(source.read_text()).body if hasattr(item, "name")}


def entry(item):
    lines = [f"## {item.name}", ""]
    if isinstance(item, ast.ClassDef):
        lines += [doc(item), ""]
        for member in item.body:
            public = isinstance(member, ast.FunctionDef) and not member.name.startswith("_")
            if public and ast.get_docstring(member):
                lines += [signature(member, f"{item.name}."), "", doc(member), ""]
    else:
        lines += [signature(item, ""), "", doc(item), ""]
    return lines


def doc(item):
    """A docstring in Markdown: sections of NumPy's style become lists."""
    lines, inside = [], False
    for line in (ast.get_docstring(item) or "").splitlines():
        if line == "::":
            continue
        if re.fullmatch(r"-{3,}", line):
            lines[-1], inside = f"**{lines[-1]}**\n", True
        elif inside and line and not line.startswith(" ") and not line.endswith("."):
            lines.append(f"- `{line}`:")
        else:
            inside = inside and (not line or line.startswith(" "))
            lines.append(line)
    return "\n".join(lines)


def signature(function, owner):
    if any(ast.unparse(d) == "property" for d in function.decorator_list):
        returns = f": {ast.unparse(function.returns)}" if function.returns else ""
        return f"```python\n{owner}{function.name}{returns}\n```"
    arguments = re.sub(r"^self,? ?", "", ast.unparse(function.args))
    returns = f" -> {ast.unparse(function.returns)}" if function.returns else ""
    return f"```python\n{owner}{function.name}({arguments}){returns}\n```"


def c_header():
    header = (ROOT / "plugins" / "abi" / "include" / "conefield_plugin.h").read_text()
    intro = "The whole contract of a plugin. [Writing a stage](../guide/writing-stages.md) explains how to use it."
    return f"# C header\n\n{intro}\n\n```c\n{header}```\n"
