"""Makes the page of a report, and the pages of answers, with the sentences that open them."""
