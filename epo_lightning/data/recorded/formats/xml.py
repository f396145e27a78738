"""XML from outside: parsed without entities, so that a small file cannot become a large one or open another."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser
from defusedxml.ElementTree import parse as defused_parse

from epo_lightning.data.errors import RecordingError

_LARGEST = 2**63


def parse(path: Path | str) -> Element:
    """The root element of a file.

    Raises:
        RecordingError: no such file, or it is empty, not well-formed, in an unknown encoding, or it declares a document
            type or entities.
    """
    # The parser is Python's own and slow; elements from the C builder make up for it, and survive any depth.
    parser = DefusedXMLParser(target=TreeBuilder(), forbid_dtd=True)
    try:
        return defused_parse(path, parser=parser).getroot()
    except FileNotFoundError:
        raise RecordingError(path, "there is no such file") from None
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    except DefusedXmlException as error:
        raise RecordingError(
            path, "the file declares a document type or entities, which may hide a bomb: remove the declaration"
        ) from error
    except ParseError as error:
        raise RecordingError(
            path, f"the file is not well-formed XML ({error}): is it complete? Fetch or export it again"
        ) from error
    except (LookupError, ValueError) as error:
        raise RecordingError(path, f"the encoding of the file is unknown ({error}): save it as UTF-8") from error


def number(text: str | None, what: str, path: Path | str) -> float:
    """The finite number that a required text or attribute holds.

    Args:
        text: None where it is missing.
        what: the name of the number and of the element it belongs to, for error messages.
        path: of the file, for error messages.

    Raises:
        RecordingError: it is missing, or no finite number.
    """
    try:
        value = float(_digits(text))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RecordingError(path, f"{what} is {_quote(text)}; a finite number was expected there")
    return value


def whole(text: str | None, what: str, path: Path | str) -> int:
    """The whole number that a required text or attribute holds; see :func:`number`."""
    try:
        value = int(_digits(text))
    except ValueError:
        value = _LARGEST
    if not -_LARGEST <= value < _LARGEST:
        raise RecordingError(path, f"{what} is {_quote(text)}; a whole number was expected there")
    return value


def _digits(text: str | None) -> str:
    """What float and int may read: Python would also take 1_000 for a number."""
    return "" if text is None or "_" in text else text


def _quote(text: str | None) -> str:
    """A text as messages show it, at most a line of it."""
    return "missing" if text is None else repr(text if len(text) <= 40 else text[:40] + "...")
