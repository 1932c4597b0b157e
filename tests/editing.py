"""Changes of a study's file, as a user makes them between two commands."""

from pathlib import Path


def edit(study: Path, old: str, new: str) -> None:
    """Replace what stands in the file wherever it stands; it has to be there."""
    file = study / "study.toml"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


def append(study: Path, text: str) -> None:
    with (study / "study.toml").open("a", encoding="utf-8") as stream:
        stream.write(text)
