"""`gridsec study`: what there is to know of a feeder, its meters and its estimators, offline."""

from __future__ import annotations

import typer

from service import cli_calibrate, cli_campaign, cli_compare, cli_droop, cli_plan, cli_report, keeping

app = typer.Typer(no_args_is_help=True)


@app.callback()
def study(context: typer.Context) -> None:
    """Study feeders and estimators."""
    context.call_on_close(keeping.idle())


app.command("redundancy")(cli_plan.redundancy)
app.command("protect")(cli_plan.protect)
app.command("detectable")(cli_plan.detectable)
app.command("calibrate")(cli_calibrate.calibrate)
app.command("campaign")(cli_campaign.campaign)
app.command("droop")(cli_droop.droop)
app.command("report")(cli_report.report)
app.command("compare")(cli_compare.compare)
