//! Unit types and their numbers: "Liberty" data, which the task sets' maps depend on, and the current multiplayer
//! ("ladder") data as an option. Times are in seconds of 16 game loops.

use serde::{Deserialize, Serialize};

/// Ticks (game loops) in a second.
pub const TICKS_PER_SECOND: f64 = 16.0;

/// Energy that healing one health point takes.
pub const ENERGY_PER_HEALTH: f64 = 0.33;
/// Health a medivac heals in a second.
pub const HEALING_RATE: f64 = 9.0;
/// How far a medivac heals, from edge to edge.
pub const HEALING_RANGE: f64 = 4.0;
/// How far a medivac looks for patients by itself, from edge to edge.
pub const HEALING_SCAN_RANGE: f64 = 6.0;
/// Energy that healing by itself needs to begin.
pub const HEALING_ENERGY_MIN: f64 = 5.0;
/// Energy a medivac begins with.
pub const ENERGY_START: f64 = 50.0;
/// Energy gained in a second.
pub const ENERGY_RATE: f64 = 0.5625;
/// Shield gained in a second.
pub const SHIELD_RATE: f64 = 2.0;
/// Ticks without damage before a shield recovers.
pub const SHIELD_DELAY_TICKS: i64 = 160;

/// How many ticks a time takes: rounded up.
pub fn ticks(seconds: f64) -> i64 {
    (TICKS_PER_SECOND * seconds - 1e-9).ceil() as i64
}

/// A type of unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum UnitType {
    /// Terran infantry; shoots ground and air.
    Marine,
    /// Terran infantry; slow missiles, strong against armour.
    Marauder,
    /// Terran aircraft; heals biological units.
    Medivac,
    /// Protoss walker; missiles against ground and air.
    Stalker,
    /// Protoss infantry; two blows at arm's length.
    Zealot,
    /// Protoss giant; burns a line across its target and walks over everybody.
    Colossus,
}

/// Which bodies meet: those of one layer push each other, layers ignore each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// Everything that walks, but for colossi.
    Ground,
    /// Colossi.
    Colossus,
    /// Aircraft.
    Air,
}

/// What a weapon may be stronger against.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attribute {
    /// Marines, zealots.
    Light,
    /// All others.
    Armoured,
}

/// How a released attack reaches its target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Delivery {
    /// At once.
    Instant,
    /// A missile of this speed, per second.
    Missile(f64),
    /// One blow at once and one this many seconds later.
    TwoBlows(f64),
    /// Twice along a line across the target, this many seconds later.
    Line(f64),
}

/// A weapon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weapon {
    /// Damage of one hit.
    pub damage: f64,
    /// More against targets of this attribute.
    pub bonus: Option<(Attribute, f64)>,
    /// How it gets there.
    pub delivery: Delivery,
    /// Seconds from one attack's beginning to the next.
    pub period: f64,
    /// Reach, from edge to edge.
    pub range: f64,
    /// How much farther the target may have gone when the wind-up ends.
    pub slop: f64,
    /// Seconds of winding up.
    pub damage_point: f64,
    /// Whether it reaches aircraft.
    pub hits_air: bool,
}

/// The numbers of a unit type.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stats {
    /// Health at the beginning, which is the most.
    pub health: f64,
    /// Shield at the beginning, which is the most.
    pub shield: f64,
    /// Taken off each hit on health.
    pub armour: f64,
    /// Energy at the most; 0 for units without.
    pub energy: f64,
    /// What weapons may be stronger against.
    pub attribute: Attribute,
    /// Whether medivacs can heal it.
    pub biological: bool,
    /// Which bodies it meets.
    pub layer: Layer,
    /// Greatest speed, per second.
    pub speed: f64,
    /// Speed gained in a second; infinite for what starts and stops at once.
    pub acceleration: f64,
    /// Radius that ranges are measured from.
    pub radius: f64,
    /// Radius of the body that pushes.
    pub separation: f64,
    /// What it attacks with.
    pub weapon: Option<Weapon>,
    /// How far it sees.
    pub sight: f64,
}

/// Which numbers units have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StatsVersion {
    /// Those of the original release, as the task sets' maps have them.
    #[default]
    Liberty,
    /// Those of current multiplayer games.
    Ladder,
}

impl UnitType {
    /// Every type.
    pub const ALL: [Self; 6] =
        [Self::Marine, Self::Marauder, Self::Medivac, Self::Stalker, Self::Zealot, Self::Colossus];

    /// Its letter in a team's name.
    pub fn letter(self) -> char {
        match self {
            Self::Marine => 'm',
            Self::Marauder => 'M',
            Self::Medivac => 'v',
            Self::Stalker => 's',
            Self::Zealot => 'z',
            Self::Colossus => 'c',
        }
    }

    /// Its place among the custom types of the task sets' maps: allies are numbered by it.
    pub fn ally_rank(self) -> usize {
        match self {
            Self::Colossus => 0,
            Self::Marauder => 1,
            Self::Marine => 2,
            Self::Medivac => 3,
            Self::Stalker => 4,
            Self::Zealot => 5,
        }
    }

    /// The game's own number of the type: enemies are of these types, and numbered by it.
    pub fn standard_id(self) -> u32 {
        match self {
            Self::Colossus => 4,
            Self::Marine => 48,
            Self::Marauder => 51,
            Self::Medivac => 54,
            Self::Zealot => 73,
            Self::Stalker => 74,
        }
    }

    /// What the feature "weapon cooldown" is divided by, in game loops. Stalker and colossus look swapped in the
    /// published environment; kept.
    pub fn cooldown_scale(self) -> f64 {
        match self {
            Self::Marine => 15.0,
            Self::Marauder => 25.0,
            Self::Medivac => 200.0,
            Self::Stalker => 35.0,
            Self::Zealot => 22.0,
            Self::Colossus => 24.0,
        }
    }

    /// Whether it is an aircraft.
    pub fn flies(self) -> bool {
        self == Self::Medivac
    }

    /// Its numbers.
    pub fn stats(self, version: StatsVersion) -> Stats {
        let liberty = self.liberty();
        match version {
            StatsVersion::Liberty => liberty,
            StatsVersion::Ladder => self.ladder(liberty),
        }
    }

    fn liberty(self) -> Stats {
        let walker = Stats {
            health: 0.0,
            shield: 0.0,
            armour: 1.0,
            energy: 0.0,
            attribute: Attribute::Armoured,
            biological: true,
            layer: Layer::Ground,
            speed: 2.25,
            acceleration: f64::INFINITY,
            radius: 0.0,
            separation: 0.0,
            weapon: None,
            sight: 9.0,
        };
        let weapon = Weapon {
            damage: 0.0,
            bonus: None,
            delivery: Delivery::Instant,
            period: 0.0,
            range: 0.0,
            slop: 1.0,
            damage_point: 0.0,
            hits_air: false,
        };
        match self {
            Self::Marine => Stats {
                health: 45.0,
                armour: 0.0,
                attribute: Attribute::Light,
                radius: 0.375,
                separation: 0.375,
                weapon: Some(Weapon {
                    damage: 6.0,
                    period: 0.8608,
                    range: 5.0,
                    damage_point: 0.05,
                    hits_air: true,
                    ..weapon
                }),
                ..walker
            },
            Self::Marauder => Stats {
                health: 125.0,
                radius: 0.5625,
                separation: 0.5,
                weapon: Some(Weapon {
                    damage: 10.0,
                    bonus: Some((Attribute::Armoured, 10.0)),
                    delivery: Delivery::Missile(20.0),
                    period: 1.5,
                    range: 6.0,
                    ..weapon
                }),
                sight: 10.0,
                ..walker
            },
            Self::Medivac => Stats {
                health: 150.0,
                energy: 200.0,
                biological: false,
                layer: Layer::Air,
                speed: 2.75,
                acceleration: 2.3125,
                radius: 0.75,
                separation: 0.75,
                sight: 11.0,
                ..walker
            },
            Self::Stalker => Stats {
                health: 80.0,
                shield: 80.0,
                biological: false,
                speed: 2.9531,
                radius: 0.625,
                separation: 0.625,
                weapon: Some(Weapon {
                    damage: 10.0,
                    bonus: Some((Attribute::Armoured, 4.0)),
                    delivery: Delivery::Missile(18.75),
                    period: 1.44,
                    range: 6.0,
                    damage_point: 0.167,
                    hits_air: true,
                    ..weapon
                }),
                sight: 10.0,
                ..walker
            },
            Self::Zealot => Stats {
                health: 100.0,
                shield: 50.0,
                attribute: Attribute::Light,
                radius: 0.5,
                separation: 0.375,
                weapon: Some(Weapon {
                    damage: 8.0,
                    delivery: Delivery::TwoBlows(0.28),
                    period: 1.2,
                    range: 0.1,
                    ..weapon
                }),
                ..walker
            },
            Self::Colossus => Stats {
                health: 200.0,
                shield: 150.0,
                biological: false,
                layer: Layer::Colossus,
                radius: 1.0,
                separation: 0.75,
                weapon: Some(Weapon {
                    damage: 20.0,
                    delivery: Delivery::Line(0.375),
                    period: 2.2,
                    range: 6.0,
                    slop: 0.0,
                    damage_point: 0.0832,
                    ..weapon
                }),
                sight: 10.0,
                ..walker
            },
        }
    }

    fn ladder(self, liberty: Stats) -> Stats {
        let weapon = |change: &dyn Fn(Weapon) -> Weapon| liberty.weapon.map(change);
        match self {
            Self::Stalker => Stats {
                weapon: weapon(&|weapon| Weapon {
                    damage: 13.0,
                    bonus: Some((Attribute::Armoured, 5.0)),
                    period: 1.87,
                    ..weapon
                }),
                ..liberty
            },
            Self::Colossus => Stats {
                health: 250.0,
                shield: 100.0,
                weapon: weapon(&|weapon| Weapon {
                    damage: 10.0,
                    bonus: Some((Attribute::Light, 5.0)),
                    period: 1.5,
                    range: 7.0,
                    ..weapon
                }),
                ..liberty
            },
            Self::Medivac => Stats { speed: 2.5, acceleration: 2.25, ..liberty },
            Self::Marine | Self::Marauder | Self::Zealot => liberty,
        }
    }

    /// Whether a unit of this type can hit one of the other: a colossus is ground and air at once.
    pub fn can_hit(self, target: Self, version: StatsVersion) -> bool {
        self.stats(version).weapon.is_some_and(|weapon| weapon.hits_air || !target.flies())
    }
}
