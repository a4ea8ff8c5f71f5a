"""Everyday words: what a thing could be besides what it is asked for.

Chosen by hand from the vocabularies of indoor and street data sets (ScanNet, ADE20K, COCO,
Cityscapes), one word a kind of thing; for models that encode any words.
"""

_TEXT = """
    wall; floor; ceiling; window; door; curtain; blinds; rug; stairs; column; railing; radiator;
    bed; nightstand; wardrobe; cabinet; shelf; desk; table; chair; armchair; sofa; stool; bench;
    cushion; blanket; towel; lamp; mirror; picture; poster; clock; board; plant; flower; vase; tree;
    computer monitor; television; keyboard; computer mouse; laptop; printer; telephone; speaker;
    cable; remote control; camera; headphones; book; paper; magazine; pen; scissors; stapler; box;
    basket; bin; bag; backpack; suitcase; umbrella; shoe; hat; shirt; jacket; glasses; watch;
    bottle; cup; glass; plate; bowl; pan; kettle; knife; fork; spoon; jar; can; tray; candle;
    refrigerator; oven; stove; microwave; toaster; sink; tap; toilet; bathtub; shower; soap;
    washing machine; fan; heater; air conditioner; apple; banana; orange; bread; cake; sandwich;
    pizza; meat; vegetable; egg; cheese; toy; doll; toy car; teddy bear; ball; dice; game; guitar;
    piano; drum; bicycle; motorcycle; car; truck; bus; train; boat; airplane; wheel; road; sidewalk;
    crosswalk; building; house; roof; fence; bridge; pole; traffic light; traffic sign; street lamp;
    fire hydrant; statue; fountain; person; child; face; hand; dog; cat; bird; horse; cow; sheep;
    fish; insect; sky; cloud; grass; bush; leaf; soil; sand; rock; mountain; water; snow
"""

CONTEXT_WORDS: tuple[str, ...] = tuple(" ".join(word.split()) for word in _TEXT.split(";"))
"""About two hundred."""
