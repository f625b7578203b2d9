"""A small study file, and mistakes in it: the replaced text, and the message on the field marked `# here`."""

BASE = """\
schema = 1
name = "small"
out = "runs/small"

[suite]
categories = ["color", "Shape"]
items = 24

[models.base]
family = "pi0-tiny"
groups = ["one"]
vlm = "reader"
untrained = "random"

[models.state]
family = "pi0-tiny-state"
finetuned_from = "base"
groups = ["other"]
untrained = "random-state"

[models.random]
family = "pi0-tiny"
random_weights = true

[models.random-state]
family = "pi0-tiny-state"
random_weights = true

[models.reader]
family = "vlm-tiny"

[conditions.plain]

[conditions.dark]
light_level = 0.7

[asks.p1]
prompt = "p1"

[asks.p2]
prompt = "p2"

[[runs]]
name = "main"
models = ["base", "state", "random", "random-state"]
conditions = ["plain"]

[[runs]]
name = "light"
models = ["base", "state"]
conditions = ["plain", "dark"]
categories = ["color"]
exclude = [{ model = "state", condition = "dark" }]

[[runs]]
name = "vlms"
models = ["reader"]
asks = ["p1", "p2"]

[probes.main]
runs = ["main"]
permutations = 100
controls = ["untrained"]

[comparisons.light]
pairs = { conditions = ["plain", "dark"], models = ["base"] }

[comparisons.tuning]
chain = ["base", "state"]

[comparisons.kinds]
groups = ["one", "other"]

[drift.words]
pairs = [
    ["reader/p1", "base"],
    ["base", "state"],
]

[tables.success]
kind = "success"
runs = ["main"]

[tables.light]
kind = "ablation"
comparison = "light"
"""

MISTAKES: list[tuple[str, str, str]] = [
    # the schema's
    ("schema = 1", "schema = 2  # here", "schema: is 2; expected 1"),
    ('name = "small"', 'name = "Small Study"  # here', "name: is 'Small Study'; string should match pattern"),
    ('out = "runs/small"', 'ouT = "runs/small"  # here', "unknown key; did you mean 'out'?"),
    ("items = 24", "items = 23  # here", "multiple of 2"),
    ("items = 24", 'items = "24"  # here', "suite.items: is '24'; expected a valid integer"),
    ('family = "pi0-tiny"\ngroups', 'famliy = "pi0-tiny"  # here\ngroups', "did you mean 'family'?"),
    ('[models.base]\nfamily = "pi0-tiny"', "[models.base]  # here", "models.base.family: is missing"),
    ('vlm = "reader"', 'vlm = "reader"\ngpus = 2  # here', "models.base.gpus: is 2; expected at most 1"),
    ('vlm = "reader"', 'vlm = "reader"\nunavailable = ""  # here', "at least 1 character"),
    ("light_level = 0.7", "light_level = 0.7\nlite = 1  # here", "unknown key"),
    (
        "light_level = 0.7",
        'rendering = "photo"  # here',
        "conditions.dark.rendering: is 'photo'; expected one of raw",
    ),
    ("light_level = 0.7", 'picture_size = "big"  # here', "is 'big'; should be a text such as 224x224"),
    ("light_level = 0.7", 'captured_calls = "each"  # here', "conditions.dark.captured_calls"),
    ("light_level = 0.7", "captured_calls = 0  # here", "conditions.dark.captured_calls"),
    ("[conditions.dark]", '[conditions.dark]  # here\nlater_views = "mean"', "the first alone is captured"),
    ('[[runs]]\nname = "main"', "[[runs]]  # here", "runs[0].name: is missing"),
    ('models = ["reader"]', "models = []  # here", "runs[2].models: is []; list should have at least 1 item"),
    ('models = ["reader"]', 'models = ["reader"]\nseeds = [-1]  # here', "is -1; expected at least 0"),
    ('controls = ["untrained"]', 'controls = ["binding"]  # here', "probes.main.controls[0]"),
    ('chain = ["base", "state"]', 'chain = ["base"]  # here', "list should have at least 2 items"),
    ('kind = "success"', 'kind = "sucess"  # here', "tables.success.kind: is 'sucess'; expected one of success"),
    ("schema = 1", "schema = true  # here", "schema: is True; should be 1"),
    ("items = 24", "items = nan  # here", "suite.items: is nan; expected a valid integer"),
    (
        "light_level = 0.7",
        "light_level = inf  # here",
        "conditions.dark.light_level: is inf; expected a finite number",
    ),
    (
        "light_level = 0.7",
        "captured_calls = true  # here",
        "conditions.dark.captured_calls: is True; expected a valid integer or all",
    ),
    ('groups = ["one"]', 'groups = ["one"]\nlabel = ""  # here', "at least 1 character"),
    ('groups = ["one"]', 'groups = ["one"]\nlabel = "a\\u001b[1m"  # here', "control character is not allowed"),
    ('out = "runs/small"', 'out = "a\\u0000b"  # here', "out: is 'a\\x00b'; a line break or control character"),
    ('models = ["reader"]', 'models = ["reader"]\nseeds = [0, 0]  # here', "0 comes twice; name each once"),
    ('chain = ["base", "state"]', 'chain = ["base", "base"]  # here', "'base' comes twice"),
    ('groups = ["one", "other"]', 'groups = ["one", "one"]  # here', "'one' comes twice"),
    (
        '["plain", "dark"], models',
        '["plain", "plain"], models',
        "comparisons.light.pairs.conditions: is ['plain', 'plain']; 'plain' comes",
    ),
    ("[models.reader]", '[models."re\\nader"]  # here', "; string should match pattern"),
    (
        'kind = "success"\nruns = ["main"]',
        'kind = "score"\nruns = ["main"]\nelsewhere = { title = "x", sorce = "y", values = { base = 1 } }  # here',
        "tables.success.elsewhere.sorce: unknown key; did you mean 'source'?",
    ),
    # names of other tables
    ('categories = ["color", "Shape"]', 'categories = ["colour"]  # here', "unknown category 'colour'; known: "),
    ("items = 24", "items = 200  # here", "200 items are asked for, and color has 150, shape has 150"),
    ('family = "vlm-tiny"', 'family = "vlm-tini"  # here', "unknown family 'vlm-tini'"),
    ('family = "vlm-tiny"', 'family = "vlm-tiny"\noptions = { warm = 1 }  # here', "models.reader.options"),
    ('vlm = "reader"', 'vlm = "raeder"  # here', "unknown model 'raeder'; known: "),
    ('vlm = "reader"', 'vlm = "state"  # here', "'state' (pi0-tiny-state) does not answer questions"),
    ('untrained = "random"\n', 'untrained = "state"  # here\n', "must be of family pi0-tiny with random_weights"),
    ('groups = ["one"]', 'groups = ["one"]\nfinetuned_from = "state"  # here', "runs in a circle: "),
    ('groups = ["one"]', 'groups = ["one"]\nweights_seed = 3  # here', "belongs to random weights"),
    (
        'groups = ["one"]',
        'groups = ["one"]\nprotocol = "act2answer"  # here',
        "the protocol act2answer does not use pi0-tiny",
    ),
    ('name = "light"', 'name = "main"  # here', "a block is already called 'main'"),
    ('models = ["reader"]', 'models = ["raeder"]  # here', "unknown model 'raeder'"),
    ('conditions = ["plain"]', 'conditions = ["plane"]  # here', "Did you mean 'plain'?"),
    ('asks = ["p1", "p2"]', 'asks = ["p1", "p3"]  # here', "unknown ask 'p3'"),
    ('models = ["reader"]', 'models = ["reader", "base"]  # here', "'base' (pi0-tiny) answers no questions"),
    (
        'models = ["base", "state"]\n',
        'models = ["base", "state", "reader"]  # here\n',
        "'reader' (vlm-tiny) does not act",
    ),
    (
        '[[runs]]\nname = "vlms"',
        '[[runs]]  # here\nname = "vlms"\nconditions = ["plain"]',
        "give either conditions",
    ),
    ('categories = ["color"]', 'categories = ["time travel"]  # here', "unknown category 'time-travel'"),
    (
        'exclude = [{ model = "state", condition = "dark" }]',
        'exclude = [{ model = "random" }]  # here',
        "model 'random' excludes no run of block 'light'",
    ),
    ("[asks.p2]", '[asks.p3]  # here\nprompt = "seen"\n\n[asks.p2]', "asks.p3: is in no run"),
    ("[conditions.dark]", "[conditions.bright]  # here\nlight_level = 1.3\n\n[conditions.dark]", "is in no run"),
    (
        "[models.reader]",
        '[models.spare]  # here\nfamily = "idle"\n\n[models.reader]',
        "models.spare: is in no run",
    ),
    # what does not fit together
    ('out = "runs/small"', 'out = "ftp://host/x"  # here', "out: runs lie in folders or at s3://"),
    ("[suite]\n", "[suite]\ncounts = { color = 10 }  # here\n", "belongs to a suite of your own"),
    (
        "[models.random]",
        '[models.failures]  # here\nfamily = "idle"\n\n[models.random]',
        "the folder of failures",
    ),
    (
        'finetuned_from = "base"',
        'finetuned_from = "base"\nlabel = "reader"',
        "models.reader: 'state' is called 'reader' too",
    ),
    ("light_level = 0.7", 'background = "absent.png"  # here', "absent.png cannot be read"),
    ('runs = ["main"]\npermutations', 'runs = ["main"]\nviews = ["meen"]  # here\npermutations', "is no view of"),
    (
        "[comparisons.light]",
        '[probes.more]\nruns = ["main"]  # here\n\n[comparisons.light]',
        "block 'main' is probed by 'main' too",
    ),
    (
        'chain = ["base", "state"]',
        'chain = ["base", "reader"]  # here',
        "no condition in common (base: dark, plain",
    ),
    (
        'groups = ["other"]',
        'groups = ["other", "one"]',
        "'state' is in 'other' and 'one'; groups have no model in common",
    ),
    (
        "[tables.success]",
        '[tables.drift]\nkind = "drift"\ndrift = "more"\n\n[drift.more]\nview = "last"  # here\n'
        'pairs = [["base", "state"]]\n\n[tables.success]',
        "the view 'last' of 'base' is not probed; its probes have mean",
    ),
    (
        "[tables.success]",
        '[probes.chosen]\nruns = ["main"]\nviews = ["last"]\ntarget = "side.chosen"\n\n[figures.all]\n'
        'kind = "curves"\nview = "last"  # here\nruns = ["main"]\n\n[tables.success]',
        "the view 'last' is not probed; the probes of `runs` have mean",
    ),
    (
        "[drift.words]",
        '[tables.drift]\nkind = "drift"\ndrift = "words"\n\n[drift.words]',
        "'reader/p1' is asked by block 'vlms' with tokens none",
    ),
    (
        'kind = "success"\nruns = ["main"]',
        'kind = "success"\nruns = ["main"]\ncomparison = "light"  # here',
        "a table of kind 'success' shows no comparison",
    ),
    ('kind = "success"\nruns', 'kind = "vlms"\nruns', "and no block of `runs` asks one"),
    (
        'kind = "success"\nruns = ["main"]',
        'kind = "probing"\nruns = ["vlms"]  # here',
        "name a block of `runs` in a table [probes.NAME]",
    ),
    (
        "[tables.light]",
        '[figures.all]\nkind = "curves"\nruns = ["vlms"]  # here\n\n[tables.light]',
        "a figure of kind 'curves' shows probes of side.correct",
    ),
    ('kind = "success"\nruns', 'kind = "stages"\nruns', "`runs` have no policy with its VLM"),
    (
        'kind = "success"\nruns = ["main"]',
        'kind = "success"\nruns = ["light"]\ncategories = ["shape"]  # here',
        "'shape' is in no block of `runs`, which have color",
    ),
    (
        'kind = "success"\nruns = ["main"]',
        'kind = "score"\nruns = ["main"]\n'
        'elsewhere = { title = "x", source = "y", values = { reader = 1 } }  # here',
        "'reader' is in no block of `runs`, so its number has no row",
    ),
    (
        'comparison = "light"',
        'comparison = "light"\nruns = ["vlms"]  # here',
        "no model of the comparison 'light'",
    ),
    (
        "[conditions.dark]\nlight_level = 0.7",
        "[conditions.dark]  # here\nlight_level = 1.0",
        "is the same as 'plain'",
    ),
    ("light_level = 0.7", "light_level = -1.0  # here", "conditions.dark"),
    ('[asks.p2]\nprompt = "p2"', '[asks.p2]  # here\nprompt = "p1"', "is the same as 'p1' for 'reader'"),
    ('prompt = "p2"', 'prompt = "p9"  # here', "asks.p2"),
    ('runs = ["main"]\npermutations', 'runs = ["mane"]  # here\npermutations', "unknown block 'mane'"),
    ('runs = ["main"]\npermutations', 'runs = ["main", "vlms"]  # here\npermutations', "asks with tokens none"),
    ("permutations = 100", "permutations = 18  # here", "18 are too few: no p can be below 0.05"),
    ('untrained = "random"\n', "", "'base' names no untrained network"),
    ("items = 24", "items = 8", "fewer than 10 items of color, shape"),
    ('chain = ["base", "state"]', 'chain = ["base", "stats"]  # here', "unknown model 'stats'"),
    ('groups = ["one", "other"]', 'groups = ["one", "third"]  # here', "unknown group 'third'"),
    ('chain = ["base", "state"]', 'chain = ["base", "state"]\ngroups = ["one", "other"]', "give exactly one of"),
    ('models = ["base"] }', 'models = ["state"] }  # here', "no block plays 'state' in 'dark'"),
    ('    ["base", "state"],', '    ["base", "stats"],', "drift.words.pairs: unknown model 'stats'"),
    ('    ["reader/p1", "base"],', '    ["reader", "base"],', "'reader' is asked in several ways"),
    ('    ["reader/p1", "base"],', '    ["reader/p3", "base"],', "no block makes the run 'reader/p3'"),
    (
        'kind = "ablation"\ncomparison = "light"',
        'kind = "ablation"',
        "a table of kind 'ablation' needs `comparison`",
    ),
    ('comparison = "light"', 'comparison = "dark"  # here', "unknown comparison 'dark'"),
    ('comparison = "light"', 'comparison = "tuning"  # here', "'tuning' has no pairs"),
    ('kind = "success"\nruns = ["main"]', 'kind = "success"\nruns = ["mane"]  # here', "unknown block 'mane'"),
    (
        "[tables.light]",
        '[figures.all]\nkind = "overview"\nruns = ["mane"]  # here\n\n[tables.light]',
        "figures.all.runs: unknown block 'mane'",
    ),
    (
        "[tables.light]",
        '[figures.all]\nkind = "bars"  # here\nruns = ["main"]\n\n[tables.light]',
        "figures.all.kind: is 'bars'; expected one of curves",
    ),
    (
        'kind = "success"\nruns = ["main"]',
        'kind = "success"\nruns = ["main"]\n'
        'elsewhere = { title = "x", source = "y", values = { base = 1 } }  # here',
        "numbers from elsewhere stand in tables of kind 'score'",
    ),
]
ELSEWHERE = {
    "'base' names no untrained network": 'controls = ["untrained"]',
    "fewer than 10 items of color, shape": 'runs = ["main"]\npermutations',
    "give exactly one of": "[comparisons.tuning]",
    "drift.words.pairs: unknown model 'stats'": "pairs = [\n",
    "'reader' is asked in several ways": "pairs = [\n",
    "no block makes the run 'reader/p3'": "pairs = [\n",
    "a table of kind 'ablation' needs `comparison`": "[tables.light]",
    "comparisons.light.pairs.conditions: is ['plain', 'plain']; 'plain' comes": "pairs = {",
    "'reader/p1' is asked by block 'vlms' with tokens none": "pairs = [\n",
    "models.reader: 'state' is called 'reader' too": "[models.reader]",
    "'state' is in 'other' and 'one'; groups have no model in common": 'groups = ["one", "other"]',
    "and no block of `runs` asks one": 'runs = ["main"]\n\n[tables.light]',
    "`runs` have no policy with its VLM": 'runs = ["main"]\n\n[tables.light]',
}
"""Where a mistake is said that is not made where it shows: the line on which this text begins."""
