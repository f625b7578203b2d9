"""Animals and plants that an OK-VQA answer may name, by kind, with their COCO classes."""

_SINGLE_WORDS = {
    "dog breed": "labrador poodle beagle collie dachshund bulldog pug terrier husky chihuahua dalmatian corgi "
    "boxer retriever shepherd rottweiler greyhound schnauzer spaniel mastiff",
    "mammal": "dog cat horse sheep cow elephant bear zebra giraffe goat pig deer rabbit squirrel monkey lion "
    "tiger camel donkey llama bison buffalo ox bull moose elk fox wolf kangaroo whale dolphin seal otter hamster "
    "mouse rat leopard cheetah hippo rhino panda",
    "bird": "duck goose swan chicken rooster turkey owl eagle hawk falcon pigeon dove seagull gull parrot "
    "parakeet macaw peacock penguin flamingo heron crane stork ostrich robin sparrow finch cardinal crow raven "
    "hummingbird pelican cockatoo cockatiel canary woodpecker",
    "fish": "shark trout salmon goldfish tuna koi",
    "insect": "butterfly bee ant spider moth dragonfly wasp ladybug",
    "reptile": "snake lizard turtle tortoise crocodile alligator frog iguana",
    "flower": "rose tulip daisy lily sunflower orchid carnation daffodil iris lavender hydrangea chrysanthemum "
    "peony lilac poppy pansy",
    "tree": "palm pine oak maple willow birch cedar spruce elm fir",
    "plant": "cactus fern ivy bamboo grass aloe succulent moss clover",
}
_TWO_WORDS = {
    "dog breed": ("golden retriever", "german shepherd", "border collie"),
    "mammal": ("polar bear", "grizzly bear", "brown bear", "black bear", "sea lion"),
    "tree": ("palm tree", "pine tree", "oak tree"),
}
KIND_OF: dict[str, str] = {
    **{name: kind for kind, words in _SINGLE_WORDS.items() for name in words.split()},
    **{name: kind for kind, names in _TWO_WORDS.items() for name in names},
}
# Answers that COCO's boxes can confirm or rule out, with the name of the box.
COCO_CLASS: dict[str, str] = {
    **{name: name for name in ["cat", "dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe"]},
    **dict.fromkeys(("polar bear", "grizzly bear", "brown bear", "black bear"), "bear"),
    **dict.fromkeys(("bull", "ox"), "cow"),
}


def singular(answer: str) -> str:
    """The listed noun that an answer such as "horses" or "butterflies" is the plural of, else the answer."""
    for plural, ending in (("ies", "y"), ("ches", "ch"), ("es", ""), ("s", "")):
        if answer not in KIND_OF and answer.endswith(plural) and answer.removesuffix(plural) + ending in KIND_OF:
            return answer.removesuffix(plural) + ending
    return answer
