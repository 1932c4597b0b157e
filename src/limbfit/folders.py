"""The files of a folder that somebody looked into."""

from pathlib import Path

_LEFT = (".DS_Store", "Thumbs.db", "desktop.ini")  # by systems; so are names that begin with ._


def list_files(folder: Path) -> list[Path]:
    """The files in a folder and those below it, by name, without what systems leave where folders are
    looked at."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [path for path in files if path.name not in _LEFT and not path.name.startswith("._")]
