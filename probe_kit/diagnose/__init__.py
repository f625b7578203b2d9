"""Why a policy ignores an input: does it arrive, does it matter, and where on the way to the action is it lost?

`inputs` names the inputs of an observation and changes one; `donors` draws whose input a frame gets;
`importance` measures how much of the action an input decides, `passage` at which sites it passes; `diagnosis` does
all of it on a run, and stores it there.
"""
