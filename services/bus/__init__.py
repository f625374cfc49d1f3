"""The bus: sessions, publishers, subscriptions, delivery, playback and credentials (Zenoh)."""
