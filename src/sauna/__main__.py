from sauna.cli import main

main()
