"""What a dataset holds of each campaign, read from its episodes.

The plan itself is in the file of the campaign.
"""

from __future__ import annotations

from dataclasses import dataclass

from backend.catalogue.database import Database
from backend.catalogue.values import DELETED


@dataclass(frozen=True, slots=True)
class CampaignEntry:
    """One campaign: items done (accepted and not deleted) and all its episodes. Times are UTC."""

    uuid: str
    piece: str
    bottom: str
    began_ns: int
    last_ns: int
    episodes: int
    done: int


def items_deleted(database: Database, campaign: str, reason: str) -> set[int]:
    """Return the items of a campaign with an episode that was deleted for this very reason."""
    sql = (
        "SELECT e.plan_item FROM episode e JOIN mark m ON m.episode = e.uuid"
        " WHERE e.campaign = ? AND e.plan_item IS NOT NULL AND m.name = ? AND m.present"
        " AND m.note = ?"
    )
    return {item for (item,) in database.rows(sql, (campaign, DELETED, reason))}


def list_campaigns(database: Database) -> list[CampaignEntry]:
    """Return the campaigns that have episodes, the newest last."""
    sql = "SELECT uuid, piece, bottom, began_ns, last_ns, episodes, done FROM campaign"
    return [CampaignEntry(*row) for row in database.rows(f"{sql} ORDER BY began_ns")]
