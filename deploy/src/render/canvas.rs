//! What pictures are drawn on: pixels or SVG.

use super::ink::Ink;

/// x to the right and y: downwards in a picture, upwards in the world.
pub type Point = [f32; 2];

/// Where a text's point is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// At its beginning.
    Left,
    /// In its middle.
    Middle,
    /// At its end.
    Right,
}

/// How a text looks: fixed-width letters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Font {
    /// Ticks, captions, legends.
    Small,
    /// Numbers on bodies.
    SmallBold,
    /// What a picture is about.
    Large,
    /// The same, as a heading.
    LargeBold,
}

impl Font {
    /// Width of every letter, the space to the next included.
    pub fn advance(self) -> f32 {
        match self {
            Self::Small | Self::SmallBold => 7.0,
            Self::Large | Self::LargeBold => 9.0,
        }
    }

    /// Whether it is a bold one.
    pub fn is_bold(self) -> bool {
        matches!(self, Self::SmallBold | Self::LargeBold)
    }
}

/// A line of text.
#[derive(Clone, Copy, Debug)]
pub struct Text<'a> {
    /// Its point: halfway up its letters, and across as `align` says.
    pub at: Point,
    /// Where the point is across.
    pub align: Align,
    /// How it looks.
    pub font: Font,
    /// Its colour.
    pub ink: Ink,
    /// A rim around its letters, which keeps them readable on anything.
    pub rim: Option<Ink>,
    /// ASCII.
    pub words: &'a str,
}

/// Something to draw on. Later marks cover earlier ones.
pub trait Canvas {
    /// Fills a rectangle.
    fn rectangle(&mut self, corner: Point, size: Point, ink: Ink);
    /// Fills a disc.
    fn disc(&mut self, centre: Point, radius: f32, ink: Ink);
    /// Draws a circle.
    fn ring(&mut self, centre: Point, radius: f32, width: f32, ink: Ink);
    /// Draws a straight line.
    fn line(&mut self, from: Point, to: Point, width: f32, ink: Ink);
    /// Fills a triangle.
    fn triangle(&mut self, corners: [Point; 3], ink: Ink);
    /// Writes a line of text.
    fn text(&mut self, text: Text<'_>);
}
