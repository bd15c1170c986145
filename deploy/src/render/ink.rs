//! Colours: few, and told apart by all people, the colour-blind included. What matters has those of Okabe and
//! Ito's palette, which was made for that.

use rit_env::BodyKind;

/// A colour and how much it covers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ink {
    /// Red, green and blue, sRGB.
    pub rgb: [u8; 3],
    /// From 0, nothing, to 1, all.
    pub opacity: f32,
}

impl Ink {
    /// Covers all below.
    pub const fn new(red: u8, green: u8, blue: u8) -> Self {
        Self { rgb: [red, green, blue], opacity: 1.0 }
    }

    /// The same colour, which covers so much.
    pub const fn at(self, opacity: f32) -> Self {
        Self { opacity, ..self }
    }

    /// What is seen where it covers this colour.
    pub fn over(self, below: [u8; 3]) -> [u8; 3] {
        let mut seen = below;
        for (seen, above) in seen.iter_mut().zip(self.rgb) {
            let below = f32::from(*seen);
            *seen = (below + (f32::from(above) - below) * self.opacity).round() as u8;
        }
        seen
    }
}

/// Behind everything.
pub const PAPER: Ink = Ink::new(250, 250, 248);
/// Behind a plot.
pub const GROUND: Ink = Ink::new(255, 255, 255);
/// Grid lines.
pub const GRID: Ink = Ink::new(232, 232, 228);
/// The lines x = 0 and y = 0.
pub const AXIS: Ink = Ink::new(205, 205, 200);
/// Around a plot.
pub const FRAME: Ink = Ink::new(150, 150, 146);
/// Words that matter.
pub const WORDS: Ink = Ink::new(30, 30, 32);
/// Words beside them.
pub const QUIET: Ink = Ink::new(98, 98, 100);
/// Numbers on bodies, and rims.
pub const WHITE: Ink = Ink::new(255, 255, 255);
/// What an agent does.
pub const ACTION: Ink = Ink::new(0, 51, 84);

/// What a step earned. Bluish green, of the same palette.
pub const REWARD: Ink = Ink::new(0, 158, 115);

/// What is left of a unit's health.
pub const HEALTH: Ink = Ink::new(0, 158, 115);
/// What is left of a unit's shield.
pub const SHIELD: Ink = Ink::new(86, 180, 233);
/// Behind both, and what is lost of them.
pub const LOST: Ink = Ink::new(60, 60, 60);
/// An attack.
pub const ATTACK: Ink = Ink::new(230, 159, 0);

/// The colour of a body.
pub const fn body(kind: BodyKind) -> Ink {
    match kind {
        BodyKind::Agent => Ink::new(0, 114, 178),
        BodyKind::Landmark => Ink::new(90, 90, 88),
        BodyKind::Prey | BodyKind::Enemy => Ink::new(213, 94, 0),
    }
}
