"""Methods against held-out clips: records, figures of all, how sure those are, and reports of them."""
