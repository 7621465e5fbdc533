"""Hooks of the site: what lies outside of ``docs/``, and where links lead.

Links in documents lead through the repository, as its readers follow them. On the site ``docs/`` is
the root, and everything else keeps its path.
"""

import os
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
OUTSIDE = (
    *("CONTRIBUTING.md", "SECURITY.md", "notebooks/*.ipynb", "notebooks/*.py", "scenes/*.png"),
    *("notebooks/results/*.md", "notebooks/results/*.png"),
)
LINK = re.compile(r"\[([^\]]*)\]\((?!https?:|#)([^)#\s]+)([^)]*)\)")
ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):(<code>)~?")


def on_files(files, config):
    """Add pages, pictures, notebooks and scripts from outside of ``docs/``."""
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            place = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Let links lead to the same files on the site; what is not on the site loses its link."""
    here = page.file.src_uri
    folder = posixpath.dirname(here if (ROOT / here).is_file() else f"docs/{here}")

    def moved(link):
        label, target, anchor = link.groups()
        target = posixpath.normpath(posixpath.join(folder, target))
        place = target.removeprefix("docs/")
        if files.get_file_from_path(place) is None and (ROOT / target).exists():
            return label
        return f"[{label}]({os.path.relpath(place, posixpath.dirname(here) or '.')}{anchor})"

    return LINK.sub(moved, markdown)


def on_page_content(html, **_):
    """Roles of docstrings, as in ``:func:`plan```, are names of code."""
    return ROLE.sub(r"\1", html)
