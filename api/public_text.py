"""Texts as an answer may have them: without a path of the server.

Files of the data folder are named relative to it. Of any other absolute path only the last part stays: a person who can
reach the file knows where it is. The service's own routes and the names of devices (`/dev/...`) stay as they are."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

#: An absolute path of two parts or more, where a text begins one; not the path of a URL, of this service, or of a
#: device.
_PATH = re.compile(
    r"(?<![\w/:.~\\-])/(?!api/|dev/|login\b|logout\b|docs\b|health|metrics\b|openapi|static/)"
    r"(?:[^\s/:;,'\"()\[\]<>|]+/)+(?P<last>[^\s/:;,'\"()\[\]<>|]*)"
)


@dataclass(frozen=True)
class PublicText:
    """Takes the server's paths out of texts; `root` is the data folder."""

    root: Path

    def within(self, text: str) -> str:
        """Return the text with files of the data folder named relative to it; for whole documents, JSON or HTML."""
        for root in dict.fromkeys((json.dumps(str(self.root))[1:-1], str(self.root))):
            text = text.replace(f"{root}/", "").replace(root, "the data folder")
        return text

    def __call__(self, text: str) -> str:
        """Return a sentence without any path of the server."""
        return _PATH.sub(lambda match: match["last"] or "a folder", self.within(text))

    def or_none(self, text: str | None) -> str | None:
        """As a call; None stays None."""
        return None if text is None else self(text)
