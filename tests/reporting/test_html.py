"""The card of a task as HTML, from the same data as its Markdown."""

from html.parser import HTMLParser

from rlcli.config.load import resolve
from rlcli.registry import find_task
from rlcli.reporting.html import templates
from rlcli.reporting.task_card import Card, Column, Table, task_card


def card_html(card, level=2):
    return str(templates().get_template("card.html.jinja").module.card(card, level))


class Cells(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.rows, self.inside = [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.inside = True

    def handle_endtag(self, tag):
        self.inside &= tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.rows[-1][-1] += data


def test_card_html_has_all_cells():
    content = task_card(resolve(find_task("cartpole")))
    rows = [row for row in Cells(card_html(content)).rows if row]
    wanted = []
    for table in content.tables:
        wanted.append([column.title for column in table.columns])
        wanted += [[cell.replace("`", "") for cell in row] for row in table.rows]
    assert rows == wanted


def test_card_html_heading_level():
    assert "<h5>Rewards</h5>" in card_html(task_card(resolve(find_task("cartpole"))), level=4)


def test_card_html_is_escaped():
    odd = "<script>alert(1)</script> `a<b` \u202e"
    table = Table(odd, odd, (Column(odd, "code"), Column("B")), ((odd, "one ` alone"),))
    text = card_html(Card(odd, odd, ((odd, odd),), (table,)))
    assert "<script" not in text
    assert "<code>a&lt;b</code>" in text
    assert "one ` alone" in text
    assert "\u202e" not in text
