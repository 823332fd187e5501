"""Which software the cabinet runs: the arm's model does not tell, the ports do."""

from __future__ import annotations

from drivers.arcs.rpc import DEVICE, RpcConnection
from drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, WrongGeneration


async def open_arcs(connection: RpcConnection, aubope_port: int) -> None:
    """Open the connection. Raises `WrongGeneration` where only the older software's port answers."""
    try:
        await connection.open()
    except (ConnectionLost, DeviceTimeout):
        if await _answers(connection.host, aubope_port):
            raise WrongGeneration(
                DEVICE,
                "connect",
                f"port {connection.port} does not answer but {aubope_port} does: this cabinet runs AUBOPE (V4)",
                remedy="It needs the ARCS software; ask the maker for the upgrade.",
            ) from None
        raise


async def _answers(host: str, port: int) -> bool:
    probe = RpcConnection(host, port)
    try:
        await probe.open()
    except DeviceError:
        return False
    await probe.close()
    return True
