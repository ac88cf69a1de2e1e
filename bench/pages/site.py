"""Hooks of the documentation's site, see mkdocs.yml.

Pages are read in two places. In the repository a link may lead to any file of the tree; on the site
such a link is words. The decisions are listed by their titles as they are in their folder, after
their index and before the experiments. A notebook is a page of its cells and outputs, beside it its
pictures and itself. And a table without a heading has no band where it would be.
"""

import base64
import json
import os
import re
from pathlib import Path
from typing import Any

NO_HEADING = re.compile(r"<thead>\s*<tr>(\s*<th[^>]*></th>)+\s*</tr>\s*</thead>")
NOTEBOOK = ".ipynb"
LINK = re.compile(r"(!?)\[((?:[^][]|\[[^][]*\])*)\]\(([^)\s]+)\)")


def on_config(config: Any) -> Any:
    """Add the decisions to the navigation."""
    docs = Path(config.docs_dir)
    decided = docs / "decisions"
    pages = [decided / "README.md", *sorted(decided.glob("0*.md")), decided / "experiments.md"]
    listed = [{title(page): page.relative_to(docs).as_posix()} for page in pages]
    config.nav = [*config.nav, {"Decisions": listed}]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add a page for each notebook, and its pictures."""
    from mkdocs.structure.files import File

    for uri in [file.src_uri for file in files if file.src_uri.endswith(NOTEBOOK)]:
        page, pictures = notebook_page(Path(config.docs_dir) / uri)
        folder = Path(uri).parent
        files.append(File.generated(config, uri.removesuffix(NOTEBOOK) + ".md", content=page))
        for name, png in pictures.items():
            files.append(File.generated(config, (folder / name).as_posix(), content=png))
    return files


def notebook_page(notebook: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its pictures by the names that the page gives them."""
    parts, pictures = [], {}
    for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        shell = source.startswith("!")  # Jupyter's sign for a command, which Python has not
        language, source = ("sh", source[1:].replace("\n!", "\n")) if shell else ("python", source)
        parts.append(f"```{language}\n{source}\n```")
        for output in cell["outputs"]:
            if "text" in output:
                parts.append("```text\n" + "".join(output["text"]).rstrip("\n") + "\n```")
            elif png := output["data"].get("image/png"):
                name = f"{notebook.stem}-{cell['id']}.png"
                pictures[name] = base64.b64decode(png)
                parts.append(f"![{''.join(output['data']['text/plain'])}]({name})")
    download = f'<a href="{notebook.name}" download>Download this page as a notebook</a>'
    return "\n\n".join([*parts, download]) + "\n", pictures


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Make links to notebooks lead to their pages, and links out of `docs/` words."""
    here = (Path(config.docs_dir) / page.file.src_uri).parent

    def led(match: re.Match[str]) -> str:
        picture, words, target = match.groups()
        path = target.partition("#")[0]
        there = Path(os.path.normpath(here / path))
        if there.suffix == NOTEBOOK and there.is_relative_to(config.docs_dir):
            return f"{picture}[{words}]({target.replace(NOTEBOOK, '.md')})"
        if not path or "://" in path or there.is_relative_to(config.docs_dir):
            return match[0]
        # What is not there is left to the build, which says that it leads nowhere.
        return match[0] if picture or not there.exists() else words

    return LINK.sub(led, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Take away the headings of tables that have none."""
    return NO_HEADING.sub("", html)


def title(page: Path) -> str:
    """The first heading of a page; its file's name if it has none."""
    heading = re.search(r"^# (.+)$", page.read_text("utf-8"), re.M)
    return heading[1] if heading else page.stem
