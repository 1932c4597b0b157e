"""The experiment ``uncertainty``: where its intervals come from, and what it stores."""
