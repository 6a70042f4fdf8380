"""Wrong inputs by the thousand, and a watch over what each does."""
