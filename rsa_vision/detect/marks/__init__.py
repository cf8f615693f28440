"""From looks to marks: polarity and film response, which candidates are marks, the last fits, and their table."""
