"""A trial on virtual people: limbs and tissues are drawn, and every one of them wears every socket."""
