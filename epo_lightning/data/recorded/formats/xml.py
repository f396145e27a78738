"""Safe parsing of XML files: entities are refused, so that a small file cannot expand or include another one."""

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
    # This parser is pure Python and slow; building elements in C compensates for it and works at any depth.
    parser = DefusedXMLParser(target=TreeBuilder(), forbid_dtd=True)
    try:
        return defused_parse(path, parser=parser).getroot()
    except FileNotFoundError:
        raise RecordingError(path, "there is no such file") from None
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    except DefusedXmlException as error:
        raise RecordingError(
            path, "the file declares a document type or entities, which can expand to any size: remove the declaration"
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
        text: None if it is missing.
        what: name of the number and its element, for error messages.
        path: path of the file, for error messages.

    Raises:
        RecordingError: it is missing or not a finite number.
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
    """The text for float and int, empty if it has underscores: Python would read 1_000 as a number."""
    return "" if text is None or "_" in text else text


def _quote(text: str | None) -> str:
    """The beginning of a text, quoted for error messages."""
    return "missing" if text is None else repr(text if len(text) <= 40 else text[:40] + "...")
