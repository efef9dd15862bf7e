"""What pyproject.toml cannot say of a distribution: where the pictures and pages are that README.md shows and links to.

UNITOUCH_GEN_URL=https://host/owner/unitouch_gen python -m build
"""

import os
import re
from pathlib import Path
from urllib.parse import urljoin

from setuptools import setup

PICTURE = r"(?m)^!\[[^\]]*\]\((?![a-z]+:)[^)]*\)\n*(?:\*[^*]+\*\n+)?"  # with the caption in italics below it
CODE_OR_LINK = r"```.*?```|`[^`\n]*`|(?P<shown>!?)\[(?P<text>[^\]]*)\]\((?![a-z]+:)(?P<target>[^)\s]+)\)"


def described(text: str, url: str) -> str:
    """A README as a package index shows it, which has no files beside it.

    Args:
        text: In Markdown, with pictures and links relative to the root of the repository.
        url: Of the repository, whose pictures are at `{url}/raw/HEAD/...` and pages at `{url}/blob/HEAD/...`. Where it
            is empty, pictures go, with their captions, and links leave their text.
    """

    def absolute(found: re.Match) -> str:
        if not found["target"]:
            return found[0]
        if not url:
            return found["text"]
        page = f"{url}/{'raw' if found['shown'] else 'blob'}/HEAD/README.md"
        return f"{found['shown']}[{found['text']}]({urljoin(page, found['target'])})"

    return re.sub(CODE_OR_LINK, absolute, text if url else re.sub(PICTURE, "", text), flags=re.DOTALL)


if __name__ == "__main__":
    url = os.environ.get("UNITOUCH_GEN_URL", "").rstrip("/")
    if url and not re.fullmatch(r"https?://[^/\s]+/\S+", url):
        raise SystemExit(f"UNITOUCH_GEN_URL is {url!r}; pass a repository's, such as https://host/owner/unitouch_gen.")
    setup(
        long_description=described(Path(__file__).with_name("README.md").read_text(encoding="utf-8"), url),
        long_description_content_type="text/markdown",
        project_urls={"Source": url, "Changelog": f"{url}/blob/HEAD/CHANGELOG.md"} if url else {},
    )
