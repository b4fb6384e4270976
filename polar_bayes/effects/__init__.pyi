from .choose import (
    choose_effects as choose_effects,
    ChosenScene as ChosenScene,
    ledger_sentences as ledger_sentences,
    ledger_summary as ledger_summary,
    ledger_table as ledger_table,
)
