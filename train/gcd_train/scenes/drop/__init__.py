"""The drop world: some things lie about, some are thrown among them, sixteen cameras stand around."""
