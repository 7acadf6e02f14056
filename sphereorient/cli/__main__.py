from sphereorient.cli import main

main()
