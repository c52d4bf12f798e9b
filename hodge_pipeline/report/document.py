"""The parts of a page, and the template that renders them as one self-contained HTML file."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from markupsafe import Markup

from hodge_pipeline.types.text import markdown_table, with_symbols

if TYPE_CHECKING:
    from jinja2 import Template

Mark: TypeAlias = Literal["", "better", "same", "worse", "mixed", "not measured"]
JPEG = b"\xff\xd8"
TEMPLATE = "page.html.j2"
WORDS_WITH_COLOUR = ("wrong", "suspect")


@dataclass(frozen=True)
class Picture:
    """A PNG or JPEG with its title and what it shows, in a sentence."""

    title: str
    caption: str
    image: bytes

    @property
    def media_type(self) -> str:
        """`image/png` or `image/jpeg`."""
        return "image/jpeg" if self.image.startswith(JPEG) else "image/png"

    @property
    def address(self) -> Markup:
        """The picture as a data URI."""
        return Markup(f"data:{self.media_type};base64,{b64encode(self.image).decode()}")


@dataclass(frozen=True)
class Linked:
    """A picture that lies beside the page, by its relative path."""

    title: str
    caption: str
    address: str


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; the first `names` columns are words, the rest numbers. The caption explains it.

    The row that begins with `highlighted` stands out; columns in `wide` hold sentences.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    names: int = 1
    highlighted: str = ""
    wide: tuple[int, ...] = ()

    def kind(self, column: int, cell: str = "") -> str:
        """The classes of a cell."""
        words = "word" if column < self.names else ""
        return f"{words}{' wide' * (column in self.wide)}{f' {cell}' if cell in WORDS_WITH_COLOUR else ''}".strip()


@dataclass(frozen=True)
class Section:
    """A part of a page: any of a table, pictures, lines of a list, commands or other text as it is typed.

    `is_large`: its pictures fill the page's width. `is_folded`: shown when it is clicked. `mark` is a word after the
    title, such as a verdict.
    """

    title: str
    caption: str = ""
    table: Table | None = None
    pictures: tuple[Picture | Linked, ...] = ()
    lines: tuple[str, ...] = ()
    text: str = ""
    mark: str = ""
    is_large: bool = False
    is_folded: bool = False

    @classmethod
    def of(cls, table: Table, *, is_folded: bool = False) -> Section:
        """A section that is this table."""
        return cls(table.title, table.caption, table, is_folded=is_folded)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to show."""
        return not (self.table or self.pictures or self.lines or self.text)


@dataclass(frozen=True)
class Banner:
    """A verdict: a mark, a headline, and what it rests on, a short line each. `word` stands in the badge in place of
    the mark's own.
    """

    mark: Mark
    headline: str
    points: tuple[str, ...]
    word: str = ""


@dataclass(frozen=True)
class Document:
    """A page: its title, what it is of, its verdicts, and its sections.

    `first` holds the sections that stand beside each other under the verdict.
    """

    title: str
    subtitle: str = ""
    banners: tuple[Banner, ...] = ()
    first: tuple[Section, ...] = ()
    sections: tuple[Section, ...] = ()


def render(document: Document) -> str:
    """The page, as HTML5 text."""
    return with_symbols(_template().render(page=document))


def markdown(tables: Sequence[Table]) -> str:
    """The tables as Markdown."""
    return "\n".join(
        f"## {one.title}\n\n{markdown_table(one.header, one.rows, one.names)}\n\n{one.caption}\n" for one in tables
    )


@cache
def _template() -> Template:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=StrictUndefined, keep_trailing_newline=True,
    )  # fmt: skip
    environment.globals["badges"] = BADGES
    return environment.get_template(TEMPLATE)


BADGES: Mapping[str, str] = {
    "better": "better", "same": "unchanged", "worse": "worse", "mixed": "look closer", "not measured": "not measured",
}  # fmt: skip
"""What a mark says in a word: no symbol that a font may lack, no colour alone."""
