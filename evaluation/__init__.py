"""How good calibench is: experiments on cameras whose truth is known. Nothing of the product imports it."""
