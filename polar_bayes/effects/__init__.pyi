from .choose import (
    choose_effects as choose_effects,
    ChosenScene as ChosenScene,
    ledger_sentence as ledger_sentence,
    ledger_summary as ledger_summary,
    ledger_table as ledger_table,
)
