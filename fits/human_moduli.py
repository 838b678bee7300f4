"""Table 1 of the paper: the modulus of the human epidermis behind each force, beside the paper's own.

    python fits/human_moduli.py                      # table on the terminal, CSV and figures in results/human_moduli
    python fits/human_moduli.py --coarse 2           # a rough first look

One reading of the model answers each row: with the layers in the ratios of m43338, force is proportional to modulus. The interval of a
row is as wide as the paper's forces are rounded (half of the last digit); what the radius of the point and the rest of the model add to it
stands in the tables beside.
"""

from __future__ import annotations

from _script import arguments, run, show, shown, study_named

from fingerjax.report.records import Row, StudyResult, Table, write_csv

LAST_DIGIT = 0.005  # gf: half of it


def intervals(result: StudyResult) -> list[Row]:
    """Each row's modulus with the ends that the rounding of its force leaves."""
    moduli = next(table for table in result.tables if table.name == "moduli")
    found = []
    for row in moduli.rows:
        half = row["our_epidermis_modulus_MPa"] * LAST_DIGIT / row["force_gf"]
        ends = {"lower_MPa": row["our_epidermis_modulus_MPa"] - half, "upper_MPa": row["our_epidermis_modulus_MPa"] + half}
        found.append({**row, **ends})
    return found


def main() -> None:
    said = arguments(__doc__, "human_moduli")
    result = run(study_named("table1", said), said.out)
    show(result, "means", "tip_radius")
    table = Table("human_moduli", "Human epidermis, 1 mm", intervals(result))
    shown(table)
    write_csv(said.out / "human_moduli.csv", table.rows)
    print(f"CSV and figures: {said.out}")


if __name__ == "__main__":
    main()
