"""Networks that say of what class a picture is."""
