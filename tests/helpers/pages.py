"""Pages of HTML that stand alone."""

import re
from html.parser import HTMLParser

ALONE = {"meta", "br"}


class Balanced(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, dict(attributes)))
        if tag not in ALONE:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in ALONE:
            assert self.open.pop() == tag


def check_page(text):
    """Refuse what is not well-formed, needs another file or a network, or shows no number."""
    parser = Balanced()
    parser.feed(text)
    assert parser.open == []
    assert not {"script", "link", "img", "image", "iframe"} & {tag for tag, _ in parser.seen}
    links = [v for _, of in parser.seen for k, v in of.items() if k in ("src", "href")]
    links += [v for _, of in parser.seen for k, v in of.items() if k == "xlink:href"]
    links += re.findall(r"url\(([^)]*)\)", text)
    assert all(link.startswith("#") for link in links)
    assert "@import" not in text and "prefers-color-scheme:dark" in text
    assert not re.search(r"\bnan\b", text)
