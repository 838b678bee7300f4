"""Table 2 of the paper: the modulus of the monkey's epidermis behind each displacement, beside the paper's own.

    python fits/monkey_moduli.py                     # table on the terminal, CSV and figures in results/monkey_moduli
    python fits/monkey_moduli.py --coarse 2          # a rough first look

The interval of a row is as wide as the paper's displacements are rounded: force grows as a power of travel, so half of the last digit,
0.005 mm, counts by that power.
"""

from __future__ import annotations

from _script import arguments, run, show, shown, study_named

from fingerjax.report.records import Row, StudyResult, Table, write_csv

LAST_DIGIT = 0.005  # mm: half of it
USUAL_POWER = 1.5  # of travel in force, for an indenter that the table presses to one travel only


def intervals(result: StudyResult) -> list[Row]:
    """Each row's modulus with the ends that the rounding of its displacement leaves."""
    tables = {table.name: table.rows for table in result.tables}
    power = {row["indenter"]: row["exponent"] for row in tables.get("growth", [])}
    found = []
    for row in tables["moduli"]:
        share = power.get(row["indenter"], USUAL_POWER) * LAST_DIGIT / row["displacement_mm"]
        E = row["our_epidermis_modulus_MPa"]
        found.append({**row, "lower_MPa": E * (1 - share), "upper_MPa": E * (1 + share)})
    return found


def main() -> None:
    said = arguments(__doc__, "monkey_moduli")
    result = run(study_named("table2", said), said.out)
    show(result, "means", "growth")
    table = Table("monkey_moduli", "Monkey epidermis", intervals(result))
    shown(table)
    write_csv(said.out / "monkey_moduli.csv", table.rows)
    print(f"CSV and figures: {said.out}")


if __name__ == "__main__":
    main()
