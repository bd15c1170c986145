//! The numbers of unit types. Enemies are of the game's own types; allies are of types that the map brings along, which
//! never acquire a target by themselves, and whose numbers depend on the game's version.

use crate::{
    error::StarCraftError,
    messages::{Unit, UnitTypeData},
};
use rit_env::combat::{StatsVersion, UnitType, translation::RawUnit, world::Side};
use std::{collections::BTreeMap, fmt, ops::Range};

/// The map's types lie in a row, in alphabetical order: Baneling, Colossus, Hydralisk, Marauder, Marine, Medivac,
/// Stalker, Zealot, Zergling.
const ROW: u32 = 9;

/// Numbers beyond which a map's own types may lie.
const CUSTOM_MIN: u32 = 1900;

/// Beyond this no number of a unit can be: places are cells, the sturdiest unit has some hundred points.
const NUMBER_MAX: f32 = 1e5;
/// Every unit has at least this health when unhurt.
const HEALTH_MIN: f32 = 1.0;

/// Types that are created to find the row by what they look like, at most.
const TRIED_MAX: usize = 64;

/// The place of a type in the row.
fn offset(kind: UnitType) -> u32 {
    match kind {
        UnitType::Colossus => 1,
        UnitType::Marauder => 3,
        UnitType::Marine => 4,
        UnitType::Medivac => 5,
        UnitType::Stalker => 6,
        UnitType::Zealot => 7,
    }
}

/// What the map's types are called in the game's data. The older map misspells one.
fn names(kind: UnitType) -> &'static [&'static str] {
    match kind {
        UnitType::Colossus => &["Colossus_RL", "Colosus_RL"],
        UnitType::Marauder => &["Marauder_RL"],
        UnitType::Marine => &["Marine_RL"],
        UnitType::Medivac => &["Medivac_RL"],
        UnitType::Stalker => &["Stalker_RL"],
        UnitType::Zealot => &["Zealot_RL"],
    }
}

/// The numbers of the map's own types.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CustomTypes(BTreeMap<UnitType, u32>);

impl CustomTypes {
    /// A row that begins here.
    pub fn row(first: u32) -> Self {
        Self(UnitType::ALL.map(|kind| (kind, first + offset(kind))).into())
    }

    /// All numbers of a row that begins here.
    pub(crate) fn row_at(first: u32) -> Range<u32> {
        first..first + ROW
    }

    /// By their names in the game's data; `None` unless all are there.
    pub fn by_name(data: &[UnitTypeData]) -> Option<Self> {
        let number = |kind: UnitType| {
            let named = data.iter().find(|unit| names(kind).iter().any(|name| unit.name().ends_with(name)));
            named.map(|unit| (kind, unit.unit_id()))
        };
        UnitType::ALL.into_iter().map(number).collect::<Option<_>>().map(Self)
    }

    /// Types that may be the map's own: one of each is created, to be told by what it looks like.
    pub fn candidates(data: &[UnitTypeData]) -> Vec<u32> {
        let custom = data.iter().map(UnitTypeData::unit_id).filter(|&id| id >= CUSTOM_MIN);
        custom.take(TRIED_MAX).collect()
    }

    /// The row of which one of each type looks as it must.
    pub fn by_looks(units: &[Unit]) -> Option<Self> {
        let looks: BTreeMap<u32, (f32, f32)> =
            units.iter().map(|unit| (unit.unit_type(), (unit.health_max(), unit.shield_max()))).collect();
        let fits = |first: u32| {
            UnitType::ALL.into_iter().all(|kind| {
                let stats = kind.stats(StatsVersion::Liberty);
                // A number from outside may be the greatest there is.
                let number = first.checked_add(offset(kind));
                number.and_then(|number| looks.get(&number))
                    == Some(&(stats.health as f32, stats.shield as f32))
            })
        };
        let firsts = looks.keys().filter_map(|id| id.checked_sub(offset(UnitType::Colossus)));
        firsts.into_iter().find(|&first| fits(first)).map(Self::row)
    }

    /// The number of a type.
    pub fn number(&self, kind: UnitType) -> u32 {
        self.0.get(&kind).copied().unwrap_or_default()
    }

    /// The type of a number.
    pub(crate) fn kind(&self, number: u32) -> Option<UnitType> {
        self.0.iter().find(|(_, own)| **own == number).map(|(&kind, _)| kind)
    }

    /// Units of both players as the translation takes them.
    ///
    /// # Errors
    /// When one cannot be.
    pub fn raw_units(&self, units: &[Unit], to: &mut Vec<RawUnit>) -> Result<(), StarCraftError> {
        to.clear();
        for unit in units {
            let wrong = |what: String| StarCraftError::Unit { what };
            let (side, kind) = match unit.owner() {
                1 => (Side::Ally, self.kind(unit.unit_type())),
                2 => (Side::Enemy, standard_kind(unit.unit_type())),
                // Neutral units, such as decoration of the map.
                _ => continue,
            };
            let kind =
                kind.ok_or_else(|| wrong(format!("type {} of player {}", unit.unit_type(), unit.owner())))?;
            let pos = unit.pos.unwrap_or_default();
            let numbers = [
                pos.x(),
                pos.y(),
                unit.health(),
                unit.health_max(),
                unit.shield(),
                unit.shield_max(),
                unit.energy(),
                unit.energy_max(),
                unit.weapon_cooldown(),
            ];
            // NaN is within no limits.
            let may_be = numbers.iter().all(|number| number.abs() <= NUMBER_MAX);
            if !may_be || unit.health_max() < HEALTH_MIN {
                return Err(wrong(format!("numbers {numbers:?} of a {kind:?}")));
            }
            let [x, y, health, health_max, shield, shield_max, energy, energy_max, weapon_cooldown] = numbers;
            to.push(RawUnit {
                side,
                kind,
                tag: unit.tag(),
                x,
                y,
                health,
                health_max,
                shield,
                shield_max,
                energy,
                energy_max,
                weapon_cooldown,
            });
        }
        Ok(())
    }

    /// All numbers of a row with their names, as the game's data have them.
    pub(crate) fn data(first: u32) -> Vec<UnitTypeData> {
        let kinds = UnitType::ALL.map(|kind| (first + offset(kind), names(kind)[0].to_owned()));
        let others = [(0, "Baneling"), (2, "Hydralisk"), (ROW - 1, "Zergling")];
        let others = others.map(|(at, name)| (first + at, format!("{name}_RL")));
        let mut all: Vec<_> = kinds.into_iter().chain(others).collect();
        all.sort_unstable();
        let data = |(id, name)| UnitTypeData { unit_id: Some(id), name: Some(name), available: Some(true) };
        all.into_iter().map(data).collect()
    }
}

impl fmt::Display for CustomTypes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let all: Vec<String> = self.0.iter().map(|(kind, number)| format!("{kind:?} {number}")).collect();
        f.write_str(&all.join(", "))
    }
}

/// The game's own type of a number.
pub(crate) fn standard_kind(number: u32) -> Option<UnitType> {
    UnitType::ALL.into_iter().find(|kind| kind.standard_id() == number)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn look(id: u32, kind: UnitType) -> Unit {
        let stats = kind.stats(StatsVersion::Liberty);
        Unit {
            unit_type: Some(id),
            health_max: Some(stats.health as f32),
            shield_max: Some(stats.shield as f32),
            ..Unit::default()
        }
    }

    #[test]
    fn a_row_is_found_by_its_names_and_by_its_looks() {
        let row = CustomTypes::row(1970);
        assert_eq!((row.number(UnitType::Colossus), row.number(UnitType::Zealot)), (1971, 1977));
        assert_eq!((row.kind(1974), row.kind(1970)), (Some(UnitType::Marine), None));
        let mut data = CustomTypes::data(1970);
        assert_eq!(data.len(), 9);
        assert_eq!(CustomTypes::by_name(&data), Some(row.clone()));
        data[1].name = Some("Unit/Name/Colosus_RL".into());
        assert_eq!(CustomTypes::by_name(&data), Some(row.clone()), "the older map's spelling");
        assert_eq!(CustomTypes::by_name(&data[..5]), None);

        assert_eq!(CustomTypes::candidates(&data), (1970..1979).collect::<Vec<_>>());
        let mut looks: Vec<Unit> = UnitType::ALL.map(|kind| look(row.number(kind), kind)).into();
        // Others that only look like it.
        looks.extend([look(1935, UnitType::Marine), look(1972, UnitType::Marine), look(2, UnitType::Zealot)]);
        assert_eq!(CustomTypes::by_looks(&looks), Some(row));
        assert_eq!(CustomTypes::by_looks(&looks[1..]), None, "no marine");
    }

    #[test]
    fn the_games_own_types_have_the_published_numbers() {
        assert_eq!(standard_kind(48), Some(UnitType::Marine));
        assert_eq!(standard_kind(1), None);
    }
}
