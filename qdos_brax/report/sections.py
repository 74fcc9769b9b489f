"""The sections of the page, in their order."""

from __future__ import annotations

from qdos_brax.report.analysis_sections import analysis_sections
from qdos_brax.report.elements import Section
from qdos_brax.report.member_analysis import MemberAnalysis
from qdos_brax.report.result_sections import first_goal_section, learning_section, scan_section, summary_section
from qdos_brax.report.run_sections import diagnostics_section, provenance_section, wall_time_section
from qdos_brax.report.study import Study
from qdos_brax.report.tables import tables


def sections(study: Study, analyses: list[MemberAnalysis]) -> list[Section]:
    """Return every section that has something to show: first the answers, then what they rest on."""
    made = (
        summary_section(study),
        learning_section(study),
        scan_section(study),
        first_goal_section(study),
        Section("Tables", tables=tables(study)),
        *analysis_sections(analyses),
        wall_time_section(study),
        diagnostics_section(study),
        provenance_section(study),
    )
    return [section for section in made if section.cards or section.figures or section.tables or section.subsections]
