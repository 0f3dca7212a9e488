"""How often --contacts auto finds the right loads: python scripts/contacts.py [--samples N] [--out DIR] writes DIR/contacts.md."""

from studies.contacts import main

if __name__ == "__main__":
    main()
